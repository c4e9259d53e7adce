"""A smoke run in a process that others have run in before: what it costs to start one is most of some of them."""

import traceback
from contextlib import redirect_stdout
from io import StringIO

import jax


def run_beside(arguments: list[str]) -> int:
    """The exit code of the runner, here; what it prints comes in one piece."""
    from experiments.__main__ import main

    with redirect_stdout(StringIO()) as printed:
        try:
            code = main(arguments)
        except Exception:
            traceback.print_exc()
            code = 1
    print(printed.getvalue(), end="", flush=True)
    jax.clear_caches()
    return code
