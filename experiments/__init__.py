"""Experiments: one folder for each question, run by `python -m experiments NAME`."""
