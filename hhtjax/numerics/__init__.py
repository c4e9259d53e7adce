"""Numerical methods that do not depend on mechanics: linear solves, scans, loops of variable length, power series."""
