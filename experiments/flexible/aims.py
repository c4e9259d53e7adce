"""What was aimed at, and whether it was met."""

from __future__ import annotations

from collections.abc import Callable

Row = dict
AIMS: dict[str, tuple[float, Callable[[dict], float]]] = {}  # words: (at most, of the numbers of `scaling`)


def cost(found: dict, scene: str, way: str, number: int) -> float:
    """us per step; number: which of the sizes."""
    rows = [row for row in found["rows"] if row["scene"] == scene]
    n = sorted({row["unknowns"] for row in rows})[number]
    return next((row["us_per_step"] for row in rows if row["unknowns"] == n and row["way"] == way), float("nan"))


def ratio(scene: str, number: int, over: str, way: str = "elements") -> Callable[[dict], float]:
    """Of a way over another."""
    return lambda found: cost(found, scene, way, number) / cost(found, scene, over, number)


AIMS |= {
    "beam, 3001 unknowns, over plain C": (3.0, ratio("beam", 2, "C, plain")),
    "the same over two-sided, vectorised C": (3.0, ratio("beam", 2, "C, two-sided, vectorised")),
    "beam, 3001 unknowns, over exudyn with modified Newton": (0.2, ratio("beam", 2, "exudyn, modified Newton")),
    "beam, exponent of time over unknowns": (1.1, lambda found: found["exponents"]["beam"]["elements"]),
    "spring chain, exponent": (1.1, lambda found: found["exponents"]["spring chain"]["elements"]),
    "lattice, 10,082 unknowns, over factor and solve in SciPy's order": (
        1.5,
        ratio("lattice", 1, "factor and solve, SciPy's order"),
    ),
    "the same in our order": (1.5, ratio("lattice", 1, "factor and solve, our order")),
    "500 links in the plane, ms per step": (2.0, lambda found: cost(found, "links", "elements", 2) / 1e3),
    "100 rods in space, ms per step": (5.0, lambda found: cost(found, "rods in space", "elements", 2) / 1e3),
    "forward derivative over value": (1.6, lambda found: found["gradients"]["forward"]["over_value"]),
    "reverse derivative over value": (3.5, lambda found: found["gradients"]["reverse"]["over_value"]),
}


def judged(found: dict) -> list[dict]:
    """Each aim with what was found."""
    rows = []
    for aim, (limit, of) in AIMS.items():
        value = of(found)
        rows.append({"aim": aim, "at_most": limit, "found": value, "met": bool(value <= limit)})
    return rows
