"""Which point of linearisation serves the non-iterative step best."""
