"""Lines of random programs: each function gives the text of an expression of variables that a `Program` has."""

from program_functions import (
    call_cond,
    call_derivative,
    call_jit,
    call_loop,
    call_scan,
    call_vmap,
    cumulated,
    double,
    filled,
    products,
    ranked,
    reduced,
    solved,
)

MODES = ("fill", "clip", "fill")


def unary(p):
    return p.choice([
        *("jnp.sin({})", "jnp.cos({})", "jnp.tanh({})", "lax.neg({})", "lax.abs({})", "jnp.exp(-lax.abs({}))"),
        *("jnp.sqrt(1 + lax.square({0}))", "lax.sqrt({})", "lax.log({})", "jnp.log(1.5 + lax.abs({}))"),
        *("lax.square({})", "lax.sign({})", "lax.floor({})", "lax.ceil({})", "lax.cbrt({})", "lax.exp2({})"),
        *("lax.round({})", "lax.round({}, lax.RoundingMethod.TO_NEAREST_EVEN)", "lax.erf({})", "lax.logistic({})"),
        *("lax.log1p({})", "lax.expm1({})", "lax.rsqrt({})", "lax.atan({})", "lax.asinh({})", "lax.sinh({})"),
        *("lax.stop_gradient({})", "lax.reciprocal({})", "jnp.nan_to_num({})", "jnp.sinc({})", "lax.tan({})"),
        *("lax.asin({})", "lax.acos({})", "lax.cosh({})", "lax.atanh({})", "lax.acosh({})", "jnp.copy({})"),
        *("steep({})", "jax.nn.relu({})", "jax.nn.softplus({})"),
    ]).format(p.pick())  # fmt: skip


def power(p):
    return f"lax.integer_pow({p.pick()}, {p.integer(-2, 4)})"


def powers(p):
    x = p.pick()
    base = p.choice([f"lax.abs({x})", x])
    return f"{base} ** {p.choice([p.number(), p.pick(lambda y: y.shape == p.shape(x)), '2', '0', '3'])}"


def binary(p):
    x = p.pick()
    y = p.like(x)
    if p.chance(0.5):
        x, y = y, x
    kind = p.choice(["+", "-", "*", "*", "/", "lax.max", "lax.min", "jnp.arctan2", "lax.rem", "jnp.hypot", "+", "-",
                     "jnp.logaddexp", "jnp.fmod", "jnp.copysign"])  # fmt: skip
    return f"{kind}(jnp.asarray({x}), jnp.asarray({y}))" if "." in kind else f"{x} {kind} {y}"


def scaled(p):
    x = p.pick()
    y = p.pick(ranked(0)) if p.chance(0.5) else p.number()
    return f"{x} {p.choice('+-*/')} {y}" if p.chance(0.7) else f"{y} {p.choice('+-*/')} {x}"


def comparison(p):
    kind = p.choice("fffi")
    x = p.pick(kind=kind)
    y = p.like(x) if kind == "f" else p.pick(lambda v: v.shape == p.shape(x) and v.dtype == p.names[x].dtype, kind="i")
    return f"{x} {p.choice(['<', '<=', '>', '>=', '==', '!='])} {y}"


def truth(p):
    x = p.pick(kind="b")
    return p.choice([
        f"~{x}",
        f"{x} {p.choice('&|^')} {p.pick(lambda y: y.shape == p.shape(x), kind='b')}",
        f"{x}.astype({p.choice(['float', 'jnp.int32', 'jnp.float32'])})",
        f"jnp.{p.choice(['any', 'all', 'sum'])}({x})",
        f"jnp.any({x}, axis=-1)" if p.shape(x) else f"~{x}",
        f"jnp.isfinite({p.pick()})",
    ])  # fmt: skip


def chosen(p):
    x = p.pick()
    which = p.pick(lambda y: y.shape == p.shape(x) or y.ndim == 0, kind="b")
    if p.shape(which) == p.shape(x) and p.chance(0.5):
        return f"lax.select_n({which}, jnp.asarray({x}), jnp.asarray({p.like(x)}))"
    return f"jnp.where({which}, {x}, {p.like(x)})"


def chosen_by_number(p):
    x = p.pick()
    which = p.pick(lambda y: y.shape in ((), p.shape(x)) and y.dtype == "int32", kind="i")
    return f"lax.select_n(lax.clamp(np.int32(0), {which}, np.int32(2)), {x}, 2 * {x}, jnp.asarray({p.like(x)}))"


def clamped(p):
    x = p.pick(double)
    if p.chance(0.3):
        return f"lax.clamp({p.pick(ranked(0), double)}, {x}, {p.pick(ranked(0), double)})"
    return f"lax.clamp({p.number()}, {x}, {p.number()})" if p.chance(0.7) else f"jnp.clip({x}, -0.5, {p.number()})"


def whole_numbers(p):
    x = p.pick(kind="i")
    y = p.pick(lambda v: v.shape == p.shape(x) and v.dtype == p.names[x].dtype, kind="i")
    return p.choice([
        *(f"{x} {o} {y}" for o in ("+", "-", "*", "&", "|", "^", "//", "%")),
        *(f"lax.{o}({x}, {y})" for o in ("div", "rem", "max", "min", "shift_left", "shift_right_arithmetic",
                                         "shift_right_logical")),
        *(f"lax.{o}({x})" for o in ("sign", "abs", "neg", "population_count", "clz", "bitwise_not")),
        *(f"{x}.astype({t})" for t in ("float", "float", "jnp.float32", "jnp.int32", "bool")),
        f"lax.integer_pow({x}, {p.integer(0, 3)})",
        f"jnp.{p.choice(['sum', 'prod', 'max', 'min'])}({x})",
    ])  # fmt: skip


def to_whole_numbers(p):
    x = p.pick()
    return p.choice([
        f"lax.round(lax.clamp(-3.0, {p.pick(double)}, 4.0)).astype(jnp.int32)",
        f"jnp.argmax({x})", f"jnp.argmin({x}, axis=0)", f"lax.argmax({x}, 0, jnp.int32)", f"jnp.argsort({x})",
        f"k[{p.integer(0, 2)}]", f"jnp.arange({p.integer(0, 4)}, dtype=jnp.int32)", f"jnp.floor({x}).astype(int)",
        f"lax.broadcasted_iota(jnp.int32, {p.shape(x)}, 0)", f"jnp.sign({x}).astype(jnp.int32)",
    ])  # fmt: skip


def single(p):
    return f"{p.pick()}.astype({p.choice(['jnp.float32', 'float'])})"


def double_again(p):
    return f"{p.pick(lambda x: x.dtype == 'float32')}.astype(float)"


# Shapes.


def reshaped(p):
    x = p.pick()
    rank = len(p.shape(x))
    order = list(range(rank))
    p.rng.shuffle(order)
    sizes = {1: ["()", "(1,)", "(1, 1)"], 4: ["(4,)", "(2, 2)", "(1, 4)"], 6: ["(6,)", "(2, 3)", "(3, 2)", "(1, 6)"],
             8: ["(2, 4)", "(2, 2, 2)", "(8,)"], 9: ["(3, 3)", "(9,)"], 3: ["(3, 1)", "(1, 3)", "(3,)"]}  # fmt: skip
    size = p.names[x].size
    to = p.choice(sizes.get(size, [f"({size},)"]))
    return p.choice([
        f"jnp.reshape({x}, {to})",
        f"lax.reshape({x}, {to}, dimensions={tuple(order)})",
        f"jnp.ravel({x}, order='F')",
        f"jnp.reshape({x}, {to}, order='F')",
    ])  # fmt: skip


def turned(p):
    x = p.pick(ranked(1, 2, 3))
    rank = len(p.shape(x))
    order = list(range(rank))
    p.rng.shuffle(order)
    return p.choice([
        f"lax.transpose({x}, {tuple(order)})", f"lax.rev({x}, {tuple(order[: p.integer(0, rank)])})", f"{x}.T",
        f"{x}[::-1]", f"jnp.roll({x}, {p.integer(-2, 2)})", f"jnp.tile({x}, 2)", f"jnp.flip({x})",
        f"jnp.repeat({x}, 2, axis=0)", f"jnp.expand_dims({x}, {p.integer(0, rank)})", f"jnp.squeeze({x})",
        f"jnp.broadcast_to({x}, (2, *{p.shape(x)}))", f"lax.broadcast({x}, (2,))", f"jnp.moveaxis({x}, 0, -1)",
        f"lax.broadcast_in_dim({x}, ({', '.join(map(str, p.shape(x)))}, 2), {tuple(range(rank))})",
        f"jnp.roll({x}, {p.integer(-2, 2)}, axis=0)", f"{x}[..., None]", f"{x}[None]",
    ])  # fmt: skip


def square_matrix(p):
    x = p.pick(ranked(1, 2), filled)
    return p.choice([f"jnp.diag({x})", f"jnp.diag({x}, 1)", f"jnp.triu({p.pick(ranked(2))})", f"jnp.diff({x})",
                     f"jnp.tril({p.pick(ranked(2))}, -1)", f"jnp.trace({p.pick(ranked(2))})"])  # fmt: skip


def joined(p):
    x = p.pick(ranked(1, 2, 3))
    rank = len(p.shape(x))
    axis = p.integer(0, rank - 1)
    others = [i for i in range(rank) if i != axis]

    def rest(y):
        return y.ndim == rank and all(y.shape[i] == p.shape(x)[i] for i in others)

    parts = [x, *(p.pick(rest, lambda v: v.dtype == p.names[x].dtype) for _ in range(p.integer(0, 2)))]
    p.rng.shuffle(parts)
    return f"jnp.concatenate([{', '.join(parts)}], axis={axis})"


def stacked(p):
    x = p.pick()
    return f"jnp.stack([{x}, jnp.asarray({p.like(x)})], axis={p.integer(-1, len(p.shape(x)))})"


def cut(p):
    x = p.pick(ranked(1, 2, 3))
    lengths = p.shape(x)
    start = [p.integer(0, n) for n in lengths]
    stop = [p.integer(a, n) for a, n in zip(start, lengths, strict=True)]
    steps = p.choice([None, tuple(p.integer(1, 3) for _ in lengths)])
    n = lengths[0]
    at = p.integer(0, n)
    return p.choice([
        f"lax.slice({x}, {tuple(start)}, {tuple(stop)}, {steps})",
        f"lax.slice({x}, {tuple(start)}, {tuple(stop)}, {steps})",
        f"lax.split({x}, ({at}, {n - at}))[{p.integer(0, 1)}]",
        f"{x}[{p.integer(-n, n - 1) if n else 0}]", f"{x}[{start[0]}:]", f"{x}[..., -1]", f"{x}[::{p.choice([2, -2])}]",
        f"jnp.split({x}, [{at}])[{p.integer(0, 1)}]",
    ])  # fmt: skip


def padded(p):
    x = p.pick(double)
    config = [(p.integer(-1, 2), p.integer(-2, 2), p.choice([0, 0, 1, 2])) for _ in p.shape(x)]
    value = p.pick(ranked(0), double) if p.chance(0.3) else f"jnp.asarray({p.number()})"
    return p.choice([f"lax.pad({x}, {value}, {config})", f"jnp.pad({x}, 1, mode='{p.choice(['edge', 'wrap'])}')"])


# Places.


def mode(p):
    kind = p.choice(MODES)
    fill = p.choice(["", ", fill_value=0.0", f", fill_value={p.number()}", ", fill_value=jnp.nan"])
    return f"mode='{kind}'" + (fill if kind == "fill" else "")


def where(p, n, outside=0.3):
    """Text of indices of an axis of n."""
    if p.chance(0.25):
        return p.choice([f"k[{p.integer(0, 2)}]", "k", "k[:2]", p.pick(ranked(0, 1), kind="i")])
    if p.chance(0.3):
        return str(p.indices(n, 1, outside)[0])
    length = p.integer(0, 4)
    return f"np.array({p.indices(n, length, outside)}, int)"


def gathered(p):
    x = p.pick(ranked(1, 2, 3))
    n = p.shape(x)[0]
    at, inside = where(p, n), [p.integer(0, n - 1) for _ in range(p.integer(0, 4))] if n else []
    if len(p.shape(x)) > 1 and p.chance(0.5):
        at = p.choice([f":, {where(p, p.shape(x)[1])}", f"{at}, {p.indices(p.shape(x)[1], 1)[0]}", f"{at}, ::-1"])
    return p.choice([
        f"{x}[np.array({inside}, int)]",
        f"{x}.at[{p.integer(0, n - 1) if n else ':'}].get(mode='promise_in_bounds')",
        *(f"{x}.at[{at}].get({mode(p)})" for _ in range(2)),
        f"jnp.take({x}, {where(p, n)}, axis=0, mode='{p.choice(['clip', 'fill', 'wrap'])}')",
        f"jnp.take_along_axis({x}, jnp.argsort({x}, axis=0), axis=0)",
    ])  # fmt: skip


def scattered(p):
    x = p.pick(ranked(1, 2, 3), double)
    at = where(p, p.shape(x)[0])
    kind = p.choice(["set", "set", "add", "multiply", "min", "max", "divide", "power", "subtract"])
    value = p.pick(ranked(0), double) if p.chance(0.4) else p.number()
    if p.chance(0.3):
        value = p.pick(double)
    how = p.choice(["", "", f", mode='{p.choice(['drop', 'clip', 'fill'])}'"])
    if p.chance(0.2):
        places = sorted(set(p.indices(p.shape(x)[0], 3))) if p.shape(x)[0] else []
        if all(i >= 0 for i in places):
            options = ", mode='promise_in_bounds', indices_are_sorted=True, unique_indices=True"
            return f"{x}.at[np.array({places}, int)].{kind}({p.number()}{options})"
    if p.chance(0.15):
        return f"{x}.at[{at}].apply(jnp.{p.choice(['sin', 'square', 'negative'])}{how})"
    if len(p.shape(x)) > 1 and p.chance(0.4):
        at = p.choice([f":, {where(p, p.shape(x)[1])}", f"{at}, {p.indices(p.shape(x)[1], 1)[0]}"])
    return f"{x}.at[{at}].{kind}({value}{how})"


def window(p):
    x = p.pick(ranked(1, 2), double)
    lengths = p.shape(x)
    sizes = tuple(p.integer(min(1, n), n) for n in lengths)
    starts = ", ".join(p.choice([f"k[{p.integer(0, 2)}]", f"{p.integer(-3, 4)}"]) for _ in lengths)
    part = p.pick(
        double, lambda y: y.ndim == len(lengths) and all(a <= b for a, b in zip(y.shape, lengths, strict=True))
    )
    i = p.choice([f"k[{p.integer(0, 2)}]", str(p.integer(-3, 4)), p.pick(ranked(0), kind="i")])
    return p.choice([
        f"lax.dynamic_slice({x}, ({starts},), {sizes})",
        f"lax.dynamic_update_slice({x}, {part}, ({starts},))",
        f"lax.dynamic_index_in_dim({x}, {i}, 0, keepdims={p.chance(0.5)})",
        f"lax.dynamic_update_index_in_dim({x}, {p.number()}, {i}, 0)",
    ])  # fmt: skip


OPERATIONS = [
    *[unary] * 4, power, powers, *[binary] * 5, *[scaled] * 2, comparison, truth, *[chosen] * 2, chosen_by_number,
    *(clamped, whole_numbers, to_whole_numbers, single, double_again, *[reshaped] * 2, *[turned] * 2),
    *(square_matrix, joined, joined, stacked, *[cut] * 2, padded, *[gathered] * 3, *[scattered] * 3, *[window] * 2),
    *(*[reduced] * 3, cumulated, *[products] * 3, solved, *[call_jit], call_cond, *[call_loop] * 2, call_scan),
    *(call_vmap, call_derivative),
]  # fmt: skip
