"""The decision tree of the how-to page "Choose a method", with measured times: `page` draws it."""

import hhtjax

STIFF, SMOOTH, MECHANISM = "stiff double pendulum", "free double pendulum", "squeezer"

# (question, if yes, if no): answers are questions, or leaves (method, its name in the JSON, error, scene)
TREE = (
    "contact or\ndry friction?",
    ("hht(), equal steps", None, "", ""),
    (
        "constraints or\nrotations?",
        (
            "six digits\nor more?",
            ("extrapolated(),\nadaptive(...)", "extrapolated, adaptive", "1e-06", MECHANISM),
            ("hht(), equal steps", "hht", "0.001", MECHANISM),
        ),
        (
            "stiff?",
            (
                "six digits\nor more?",
                ("rodas5p(),\nadaptive(...)", "rodas5p, adaptive", "1e-06", STIFF),
                ("hht(), equal steps", "hht", "0.001", STIFF),
            ),
            (
                "eight digits\nor more?",
                ("taylor(),\nadaptive(...)", "taylor, adaptive", "1e-08", SMOOTH),
                ("tsit5(),\nadaptive(...)", "tsit5, adaptive", "1e-06", SMOOTH),
            ),
        ),
    ),
)


def time_ms(times, method, error, scene):
    """Of a later call, to this error."""
    return 1e3 * next(entry["time_s"][error] for entry in times[scene] if entry["method"] == method)


def leaf_text(times, leaf):
    """The method, and what was measured of it."""
    text, method, error, scene = leaf
    if method is None:
        return f"{text}\nonly this family solves for these forces"
    return f"{text}\n{scene}:\n{time_ms(times, method, error, scene):.2g} ms to {float(error):.0e}"


def draw(ax, times, node, depth=0, row=0.0):
    """Draws a node and what is below it; returns its height, and the first row that is free."""
    is_leaf = len(node) == 4
    if is_leaf:
        ax.text(depth, row, leaf_text(times, node), ha="left", va="center", bbox={"boxstyle": "round", "fc": "#D7ECF7"})
        return row, row + 1
    heights, free = [], row
    for child in node[1:]:
        height, free = draw(ax, times, child, depth + 1, free)
        heights.append(height)
    middle = sum(heights) / 2
    for height, answer, colour in zip(heights, ("yes", "no"), hhtjax.plot.COLOURS, strict=False):
        ax.annotate(
            "", (depth + 0.98, height), (depth + 0.25, middle), arrowprops={"arrowstyle": "->", "color": colour}
        )
        side = "bottom" if height < middle else "top"  # of the arrow; rows count downwards
        ax.text(depth + 0.66, middle + 0.6 * (height - middle), answer, color=colour, ha="right", va=side)
    ax.text(depth, middle, node[0], ha="left", va="center", bbox={"boxstyle": "round", "fc": "#FBF3D9"})
    return middle, free


def draw_tree(times, path):
    """Writes the figure."""
    with hhtjax.plot.style():
        fig, ax = hhtjax.plot.subplots(width=175, height=120)
        _, rows = draw(ax, times, TREE)
        ax.set(xlim=(-0.1, 5.0), ylim=(rows - 0.4, -0.6))
        ax.axis("off")
        fig.savefig(path)
