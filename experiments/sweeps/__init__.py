"""Sweeps, many devices, large systems and real time: one module for each part."""
