"""Random programs, with the machinery and without: python tests/programs.py --count N --seed S.

A program is traced as the machinery makes it, and as JAX does, under linearisation, transposition and vmap, and both
are evaluated operation by operation (by_numpy.py). They shall agree to 1e-12 of the largest number in each array, and
in NaN, infinities and signs of zeros. Two licences: rounding may be magnified, so a larger difference counts only if
the plain program disturbed by single roundings stays far closer; and in a sum of products a factor of zero may hide
what is not finite.
"""

import argparse
import random
import time
import traceback
from collections import Counter
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from by_numpy import Numbers, is_close, signs  # noqa: E402
from jax.extend.core import jaxpr_as_fun  # noqa: E402
from jax.flatten_util import ravel_pytree  # noqa: E402
from program_writer import HEADER, function, program  # noqa: E402

from hhtjax.xla.kernels import STAGED, staged  # noqa: E402
from hhtjax.xla.linear_maps import linear_map  # noqa: E402
from hhtjax.xla.scalars import by_scalars, join, split  # noqa: E402
from hhtjax.xla.sharing import in_stages  # noqa: E402

RTOL = 1e-12


class Difference(NamedTuple):
    """Where a program does not give the same: column, mode, what was found and expected."""

    column: str
    mode: str
    found: Any
    expected: Any


# Columns: a function of arrays, as the machinery evaluates it.


def on_scalars(f):
    return lambda *args: join(by_scalars(f)(*split(args)))


def stages(f):
    def g(*args):
        flat, back = jax.tree.flatten(jax.eval_shape(f, *args))
        return back.unflatten(in_stages(STAGED, lambda *args: jax.tree.leaves(f(*args)), *args))

    return g


def whole(f):
    return on_scalars(staged(f))


def plainly(f):
    return f


COLUMNS = {"scalars": on_scalars, "stages": stages, "whole": whole}


# Modes: functions of (x, y, k, directions) made of f.


def floats(tree):
    return [y for y in jax.tree.leaves(tree) if jnp.issubdtype(y.dtype, jnp.floating)]


def directions(tree):
    """Arrays like these, of numbers without meaning."""
    return [jnp.asarray(np.cos(1.0 + 2.0 * np.arange(x.size)).reshape(x.shape), x.dtype) for x in tree]


def both(f):
    """Values, linearised, and transposed."""

    def g(x, y, k):
        values, tangent = jax.linearize(lambda x, y: floats(f(x, y, k)), x, y)
        along = tangent(*directions([x, y]))
        return values, along, jax.linear_transpose(tangent, x, y)(directions(values))

    return g


def forward(f):
    return lambda x, y, k: jax.jvp(lambda x, y: floats(f(x, y, k)), (x, y), tuple(directions([x, y])))


def batched(f):
    def members(x):
        return jnp.stack([x, x[..., ::-1] if x.ndim else -x])

    return lambda x, y, k: jax.vmap(lambda x, y, k: (f(x, y, k), forward(f)(x, y, k)))(*map(members, (x, y, k)))


def jacobian(matrix):
    """matrix: (linear map, vector) -> its matrix."""

    def of(f):
        def g(x, y, k):
            z, back = ravel_pytree((x, y))
            linear = jax.linearize(lambda z: ravel_pytree(floats(f(*back(z), k)))[0], z)[1]
            return matrix(linear, z) if z.size else ()

        return g

    return of


def columns_of(linear, z):
    return jax.vmap(linear, out_axes=1)(jnp.eye(z.size, dtype=z.dtype))


MODES = {"value": lambda f: f, "derivatives": both, "forward": forward, "vmap": batched}


def variants(f, rng=None):
    """(column, mode, function of the program, the same with the machinery, whether lenient): all, or one of each mode."""
    chosen = list(COLUMNS.items())
    for mode in ("value", "derivatives", "vmap"):
        for name, column in chosen if rng is None else [rng.choice(chosen)] if mode != "value" else []:
            yield name, mode, MODES[mode](f), MODES[mode](column(f)), False
    plain, fast = jacobian(columns_of)(f), jacobian(linear_map)(f)
    matrices = [("matrix", "value", plain, fast, True), ("whole", "matrix", plain, on_scalars(staged(fast)), True)]
    yield from matrices if rng is None else [rng.choice(matrices)]


def traced(f, args):
    """The program of f, and the structure of its results."""
    return jax.make_jaxpr(f, return_shape=True)(*args)


def compare(f, args, count=None, rng=None):
    """The differences of a function of (x, y, k). rng: which columns are taken, instead of all."""
    count = Counter() if count is None else count
    closed, shape = traced(f, args)
    structure = jax.tree.structure(shape)

    def again(*args):  # faster than to trace f anew
        return structure.unflatten(jaxpr_as_fun(closed)(*args))

    references = {}
    for column, mode, plain, fast, lenient in variants(again, rng):
        key = mode if column != "matrix" else "matrix"
        if key not in references:
            references[key] = _reference(plain, args)
        if references[key] is None and mode == "derivatives":  # a loop: forward mode only
            key, plain, fast = "forward", forward(again), forward(COLUMNS[column](again))
            if key not in references:
                references[key] = _reference(plain, args)
        if references[key] is None:
            count["plain fails"] += 1
            continue
        reference, expected = references[key]
        try:
            found = Numbers()(traced(fast, args)[0], *args)
        except Exception as error:
            yield Difference(column, mode, "".join(traceback.format_exception(error)[-6:]), None)
            continue
        sums = any(e.primitive.name in ("dot_general", "reduce_sum", "cumsum") for e in _everywhere(reference.jaxpr))
        if lenient:  # unit vectors: a zero times what is not finite is nothing
            found, expected = zip(*map(_where_finite, found, expected), strict=True) if found else ((), ())
        verdict = judge(found, expected, reference, args, lenient, sums)
        count[verdict] += 1
        if verdict.startswith("different"):
            yield Difference(column, mode, found, expected)


def _where_finite(found, expected):
    if found.shape != expected.shape:
        return found, expected
    finite = np.isfinite(expected)
    return np.where(finite, found, 0), np.where(finite, expected, 0)


def _reference(f, args):
    try:
        trace = traced(f, args)[0]
        return trace, Numbers()(trace, *args)
    except Exception:
        return None


def _everywhere(jaxpr):
    for eqn in jaxpr.eqns:
        yield eqn
        for inner in jax.tree.leaves(list(eqn.params.values())):
            if hasattr(inner, "eqns"):
                yield from _everywhere(inner)


def judge(found, expected, reference, args, lenient, sums):
    """In a word."""
    if len(found) != len(expected):
        return "different number of results"
    if all(is_close(a, b, RTOL) for a, b in zip(found, expected, strict=True)):
        if lenient or sums or all(np.array_equal(signs(a), signs(b)) for a, b in zip(found, expected, strict=True)):
            return "same"
        words = "different signs of zero"
    else:
        words = "different"
        if sums:
            expected = Numbers(lenient="sums")(reference, *args)
            if all(is_close(a, b, RTOL) for a, b in zip(found, expected, strict=True)):
                return "same but for zeros times what is not finite"
    spread = []
    for i in range(6):
        spread.append(Numbers(np.random.default_rng(i))(reference, *args))
    if all(_within(a, b, others) for a, b, *others in zip(found, expected, *spread, strict=True)):
        return "badly conditioned" if words == "different" else "zero by rounding"
    return words


def _within(a, b, others):
    """Whether a is as near to b as other roundings bring it."""
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    if is_close(a, b, RTOL) and np.array_equal(signs(a), signs(b)):
        return True
    if not np.issubdtype(b.dtype, np.inexact):
        return any((x != b).any() for x in others)
    with np.errstate(all="ignore"):
        if any((np.isfinite(x) != np.isfinite(b)).any() or (signs(x) != signs(b)).any() for x in others):
            return True
        reach = max(np.nanmax(np.abs(x - b), initial=0.0) for x in others)
        return is_close(a, b, max(RTOL, 30 * reach / max(np.nanmax(np.abs(b), initial=0.0), 1e-300)))


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
    return f"{difference.column}, {difference.mode}"


def report(seed, text, args, difference):
    """A program that can be run, and what was found."""
    numbers = [f"{name} = np.array({x.tolist()}, {str(x.dtype)!r})" + (f".reshape({x.shape})" if 0 in x.shape else "")
               for name, x in zip("xyk", args, strict=True)]
    print(f"# {'-' * 20} seed {seed}: {difference.column}, {difference.mode}", text, *numbers, sep="\n")
    print("# found", difference.found, "\n# expected", difference.expected, flush=True)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--header", action="store_true", help="print what stands above every program")
    parser.add_argument("--all", action="store_true", help="every difference, not only the first of each kind")
    options = parser.parse_args(argv)
    if options.header:
        print(HEADER)
    start, count, different, kinds = time.perf_counter(), Counter(), 0, Counter()
    for seed in range(options.seed, options.seed + options.count):
        rng = random.Random(seed)
        text, args = program(rng, rng.randint(3, 15))
        with np.errstate(all="ignore"):
            found = next(iter(compare(function(text), args, count)), None)
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


if __name__ == "__main__":
    main()
