"""README.md beside this file, made from page.md and friction.json.

`python -m experiments.friction.page`
"""

import json
from pathlib import Path

from experiments.page import table

HERE = Path(__file__).parent


def page(numbers):
    """The text of README.md."""
    saved = [
        [
            f"{x['error_m']:.1e}",
            f"{x['steps']:.0f}",
            *(f"{x[way]:.0f}" if way in x else "" for way in ("tanh", "MuJoCo", "exudyn")),
        ]
        for x in numbers["equal_errors"]
    ]
    creep = [[way, f"{abs(q[-1]):.2g}"] for way, q in numbers["creep"]["q_m"].items()]
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            machine=numbers["machine"],
            switches=numbers["switches"],
            samples=numbers["samples"],
            most=max(row["steps"] for row in numbers["rows"]),
            saved=table(
                ["error (m)", "steps, set-valued", "tanh / set-valued", "MuJoCo / set-valued", "exudyn / set-valued"],
                saved,
            ),
            first_error=saved[0][0],
            first_steps=saved[0][1],
            first_tanh=saved[0][2],
            last_error=saved[-1][0],
            last_tanh=saved[-1][2],
            worst_creep=f"{max(abs(q[-1]) for q in numbers['creep']['q_m'].values()):.2g}",
            duration=numbers["creep"]["t_s"][-1],
            creep=table(["law", "movement (m)"], creep),
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "friction.json").read_text())))
