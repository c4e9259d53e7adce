"""Random programs, with the machinery and without: python tests/programs.py --count N --seed S.

Each is compared as columns.py says, in one column for each mode, drawn by chance; the first three differences of each
kind are printed as programs with as few lines as show them.
"""

import argparse
import random
import time
from collections import Counter

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
import whole_runs  # noqa: E402
from columns import compare  # noqa: E402
from program_writer import HEADER, function, program  # noqa: E402


def smaller(text, args):
    """The same program with fewer lines and a difference still."""
    lines = text.splitlines()
    done = False
    while not done:
        done = True
        for i in reversed(range(1, len(lines))):
            for attempt in _without(lines, i):
                if _differs("\n".join(attempt), args):
                    lines, done = attempt, False
                    break
            if not done:
                break
    return "\n".join(lines)


def _without(lines, i):
    """Programs without line i, or with fewer results."""
    if lines[i].startswith("    return ") and i == len(lines) - 1:
        names = lines[i].removeprefix("    return ").rstrip(",").split(", ")
        made = [x.split(" = ")[0].strip() for x in lines if x.startswith("    a")]
        for name in names if len(names) > 1 else made[: made.index(names[0])] if names[0] in made else []:
            yield [*lines[:i], f"    return {name},"]
        return
    if lines[i].lstrip().startswith("def "):
        depth = len(lines[i]) - len(lines[i].lstrip())
        stop = next(j for j in range(i + 1, len(lines)) if len(lines[j]) - len(lines[j].lstrip()) <= depth)
        yield lines[:i] + lines[stop:]
    elif not lines[i].lstrip().startswith("return"):
        yield lines[:i] + lines[i + 1 :]


def _differs(text, args):
    try:
        return next(iter(compare(function(text), args)), None) is not None
    except Exception:
        return False


def _kind(difference):
    """What tells differences of different causes apart, roughly."""
    if isinstance(difference.found, str):
        return difference.found.strip().splitlines()[-3 if "----" in difference.found else -1]
    return f"{difference.mode} {difference.column}"


def report(seed, text, args, difference):
    """A program that can be run, and what was found."""
    numbers = [
        f"{name} = np.array({x.tolist()}, {str(x.dtype)!r})" + (f".reshape({x.shape})" if 0 in x.shape else "")
        for name, x in zip("xyk", args, strict=True)
    ]
    print(f"# {'-' * 20} seed {seed}: {difference.column}, {difference.mode}", text, *numbers, sep="\n")
    print("# found", difference.found, "\n# expected", difference.expected, flush=True)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--header", action="store_true", help="print what stands above every program")
    parser.add_argument("--all", action="store_true", help="every difference, not only the first of each kind")
    parser.add_argument("--whole-runs", type=int, default=0, metavar="K", help="compiled runs of random systems, after")
    options = parser.parse_args(argv)
    if options.header:
        print(HEADER)
    start, count, different, kinds = time.perf_counter(), Counter(), 0, Counter()
    for seed in range(options.seed, options.seed + options.count):
        rng = random.Random(seed)
        text, args = program(rng, rng.randint(3, 15))
        with np.errstate(all="ignore"):
            try:
                found = next(iter(compare(function(text), args, rng, count)), None)
            except NotImplementedError as error:
                count[f"{error}"[:100]] += 1
                continue
            if found is not None:
                different += 1
                kinds[kind := _kind(found)] += 1
                if kinds[kind] > 3 and not options.all:
                    continue
                text = smaller(text, args)
                report(seed, text, args, next(iter(compare(function(text), args)), found))
    seconds = time.perf_counter() - start
    for kind, n in kinds.most_common():
        print(n, "x", kind)
    print(f"{options.count} programs, {different} differences")
    print(f"{seconds:.0f} s, {options.count / seconds:.1f} programs a second;", dict(count))
    if options.whole_runs:
        whole_runs.main(options.whole_runs, options.seed)


if __name__ == "__main__":
    main()
