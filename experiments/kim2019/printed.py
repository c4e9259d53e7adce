"""What Kim et al. (2019) print in Tables 2 and 5, and where they misprint it."""

STEP_SIZES = (1e-4, 1e-3, 1e-2, 1e-1)  # s
COLUMNS = ("implicit Euler", "conventional HHT", "non-iterative HHT")

# scene -> step size -> angle -> RMS error in rad by column
TABLES = {
    "stiff": (
        ((1.1842e-4, 2.8817e-6, 2.8817e-6), (1.1845e-4, 2.8891e-6, 2.8891e-6)),
        ((1.1617e-3, 3.0621e-6, 3.0623e-6), (1.1620e-4, 3.1147e-6, 3.1165e-6)),
        ((9.7997e-3, 1.1557e-4, 1.1565e-4), (9.8024e-3, 1.1569e-4, 1.1580e-4)),
        ((3.8964e-2, 1.1517e-2, 1.1546e-2), (3.8974e-2, 1.1519e-2, 1.1548e-2)),
    ),
    "free": (
        ((5.1564e-3, 2.4153e-5, 2.4153e-5), (5.3746e-3, 2.1765e-5, 2.1766e-5)),
        ((4.9790e-2, 2.4770e-5, 2.5459e-5), (5.1106e-2, 2.2632e-5, 2.3612e-5)),
        ((3.5351e-1, 5.5328e-4, 7.5125e-4), (3.4345e-1, 7.1164e-4, 8.9347e-4)),
        ((8.0219e-1, 7.0335e-2, 1.4275e-1), (8.4097e-1, 8.2335e-2, 1.7977e-1)),
    ),
}

# (scene, index of the step size, angle) -> the row as it has to be read, and why
MISPRINTS = {
    ("stiff", 1, 1): ((1.1620e-3, 3.1147e-6, 3.1165e-6), "exponent of 1.1620e-4: q1 has 1.1617e-3"),
    **{
        ("free", i, angle): ((euler, second, first), "HHT columns swapped")
        for i in (1, 2)
        for angle, (euler, first, second) in enumerate(TABLES["free"][i])
    },
}


def read(scene, i, angle):
    """The printed row, the row as it has to be read, and why; the same twice and "" where nothing is wrong."""
    printed = TABLES[scene][i][angle]
    return printed, *MISPRINTS.get((scene, i, angle), (printed, ""))
