"""What the paper does not say (3): the repaired non-iterative forms are of order two, one better than converged."""

import numpy as np

from experiments.kim2019 import pendulum
from hhtjax.plot import error_against_h, subplots

METHODS = ("conventional HHT", "non-iterative HHT", "converged", "refreshed", "predictor", "auto")
SHOWN = (0.0, -0.05, -0.1, -0.3)


def run(report, fast):
    """RMS errors of q1 over step size and alpha; order at the fine end; ratios to the converged method."""
    sizes = pendulum.FAST_STEP_SIZES if fast else pendulum.STEP_SIZES
    scenes, methods = (("free",), METHODS[:4]) if fast else (("free", "stiff"), METHODS)
    pendulum.compile_all(scenes, methods)
    numbers, rows = [], []
    for scene in scenes:
        errors = {m: np.array([pendulum.rms_errors(scene, m, h)[0][:, 0] for h in sizes]) for m in methods}
        for alpha in SHOWN:
            k = pendulum.ALPHAS.index(alpha)
            for method in methods:
                error = errors[method][:, k]
                entry = {
                    "scene": scene,
                    "alpha": alpha,
                    "method": method,
                    "rms_error_q1_rad": error.tolist(),
                    "order": float(np.log(error[1] / error[0]) / np.log(sizes[1] / sizes[0])),
                    "error_over_converged": (error / errors["converged"][:, k]).tolist(),
                }
                numbers.append(entry)
                if alpha in (0.0, -0.3):
                    shown = [sizes.index(h) for h in (1e-3, 1e-2, 1e-1)]
                    ratios = np.array(entry["error_over_converged"])[shown]
                    rows.append([f"{scene}, {alpha:g}", method, entry["order"], *error[shown], *ratios])
        report.progress(
            f"{scene} pendulum: {len(methods)} methods, {len(sizes)} step sizes, {len(pendulum.ALPHAS)} alphas"
        )
    print("RMS error of q1 (rad) at h = 1e-3, 1e-2, 1e-1 s, and the same over the converged method's")
    report.table(["scene, alpha", "method", "order", "1e-3", "1e-2", "1e-1", "ratio", "ratio", "ratio"], rows)
    report.figure("kim2019_repaired", figure(sizes, numbers))
    return {"step_sizes_s": list(sizes), "entries": numbers}


def figure(sizes, numbers):
    """Error against step size: rows scenes, columns alpha."""
    scenes, alphas = sorted({n["scene"] for n in numbers}), (0.0, -0.05, -0.3)
    shape = {"sharex": True, "sharey": "row", "squeeze": False}
    drawn, panels = subplots(len(scenes), 3, width=175, height=25 + 55 * len(scenes), **shape)
    for axes, (scene, alpha) in zip(panels.flat, ((s, a) for s in scenes for a in alphas), strict=True):
        curves, lines = {}, {}
        for entry in (x for x in numbers if (x["scene"], x["alpha"]) == (scene, alpha)):
            old = entry["method"] in METHODS[:2]
            label = f"{entry['method']}, as printed" if old else f"hht, {entry['method']}"
            curves[label], lines[label] = (sizes, entry["rms_error_q1_rad"]), {"ls": ":" if old else "-", "lw": 1}
        error_against_h(curves, lines=lines, key=False, ax=axes)
        axes.set(title=f"{scene}, $\\alpha$ = {alpha:g}", ylabel="RMS error of $q_1$ (rad)", ylim=(None, 10))
        axes.label_outer()
    drawn.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return drawn
