"""Lines of random programs: sums, products, and functions within functions."""


def ranked(*ranks):
    return lambda x: x.ndim in ranks


def filled(x):
    return x.size > 0


def double(x):
    return x.dtype == "float64"


# Sums.


def reduced(p):
    x = p.pick(ranked(1, 2, 3))
    axes = p.choice([None, 0, -1, tuple(i for i in range(len(p.shape(x))) if p.chance(0.5))])
    kind = p.choice(["sum", "sum", "prod", "max", "min", "mean", "var", "linalg.norm"])
    if kind == "linalg.norm":
        return f"jnp.linalg.norm({p.pick(ranked(1))})"
    initial = ", initial=0.5" if kind in ("max", "min", "sum", "prod") and p.chance(0.2) else ""
    return f"jnp.{kind}({x}, axis={axes}{initial}{p.choice(['', '', ', keepdims=True'])})"


def cumulated(p):
    x = p.pick(ranked(1, 2))
    kind = p.choice(["cumsum", "cumprod", "cummax", "cummin", "cumlogsumexp"])
    return p.choice([f"lax.{kind}({x}, axis=0, reverse={p.chance(0.4)})", f"jnp.sort({x})", f"jnp.sort({x}, axis=0)",
                     f"jax.scipy.special.logsumexp({x})", f"jnp.median({x})"])  # fmt: skip


def products(p):
    x, y = p.pick(ranked(1, 2, 3), double), p.pick(ranked(1, 2, 3), double)
    if p.chance(0.3):
        y = p.constant(p.shape(y))
    elif p.chance(0.2):
        x = p.constant(p.shape(x))
    v, w, u = p.pick(ranked(1)), p.pick(ranked(1)), p.pick(ranked(2))
    return p.choice([
        f"{x} @ {y}", f"jnp.outer({v}, {w})", f"jnp.vdot({x}, {y})", f"jnp.tensordot({x}, {y}, 1)", f"{u} @ {u}.T",
        f"jnp.einsum('i,j,j->i', {v}, {w}, {w})", f"jnp.einsum('ij,kj->ik', {u}, {u})", f"jnp.inner({v}, {v})",
        f"jnp.einsum('ij,ij->j', {u}, {u})", f"jnp.einsum('ii->i', {u})", f"jnp.einsum('ijk,ijl->ikl', {x}, {x})",
        f"jnp.cross({v}, {w})", f"jnp.kron({v}, {w})", f"{u} @ {v}", f"{v} @ {u}", f"{p.constant((3, 3))} @ {x}",
        f"lax.dot_general({u}, {u}, (((1,), (1,)), ((), ())), precision='highest')",
        f"lax.dot_general({u}, {u}, (((1,), (1,)), ((0,), (0,))), preferred_element_type=jnp.float32)",
        f"jnp.convolve({v}, {w})",
    ])  # fmt: skip


def solved(p):
    b = p.pick(lambda x: x.shape in ((2,), (3,), (4,)), double)
    n = p.shape(b)[0]
    matrix = f"(4 * jnp.eye({n}) + jnp.outer(jnp.sin({b}), {p.like(b)}))"
    return p.choice([
        f"jnp.linalg.solve({matrix}, {b})", f"jnp.linalg.inv({matrix})", f"jnp.linalg.det({matrix})",
        f"lax.custom_linear_solve(lambda v: {matrix} @ v, {b}, lambda _, b: jnp.linalg.solve({matrix}, b),"
        f" lambda _, b: jnp.linalg.solve({matrix}.T, b))",
    ])  # fmt: skip


# Functions within functions.


def call_jit(p):
    x, y = p.pick(), p.pick()
    inner = p.body({"u": x, "v": y})
    name = p.define("u, v", inner, _last(inner))
    return p.choice([f"jax.jit({name})({x}, {y})", f"jax.checkpoint({name})({x}, {y})", f"{name}({x}, {y})"])


def call_cond(p):
    x, y = p.pick(), p.pick()
    inner = p.body({"u": x, "v": y})
    z = _last(inner)
    name = p.define("u, v", inner, z)
    like = inner.names[z]
    other = f"lambda u, v: jnp.full({like.shape}, {p.number()}).astype('{like.dtype}')"
    if p.chance(0.4):
        third = f"lambda u, v: jnp.sin({name}(u, v))" if like.dtype.kind == "f" else name
        return f"lax.switch(k[{p.integer(0, 2)}], [{name}, {other}, {third}], {x}, {y})"
    which = p.choice([p.pick(ranked(0), kind="b"), f"k[0] > {p.integer(-1, 3)}", p.choice(["True", "False"])])
    return f"lax.cond({which}, {name}, {other}, {x}, {y})"


def call_loop(p):
    x, y = p.pick(double), p.pick(double)
    inner = p.body({"u": x, "v": y})
    name = p.define("u, v", inner, _carried(p, inner, "u"))
    count = p.integer(0, 3)
    traced = f"k[{p.integer(0, 2)}]"
    return p.choice([
        f"lax.fori_loop(0, {count}, lambda i, u: {name}(u, {y}), {x})",
        f"lax.fori_loop(0, {traced}, lambda i, u: {name}(u, {y}), {x})",
        f"lax.fori_loop({traced}, 3, lambda i, u: {name}(u, {y}) + 0.1 * i, {x})",
        f"lax.while_loop(lambda c: c[0] < {traced}, lambda c: (c[0] + 1, {name}(c[1], {y})), (np.int32(0), {x}))[1]",
        f"lax.while_loop(lambda c: (c[0] < 3) & jnp.all(lax.abs(c[1]) < 1.0),"
        f" lambda c: (c[0] + 1, {name}(c[1], {y})), (0, {x}))[1]",
    ])  # fmt: skip


def call_scan(p):
    x, y = p.pick(double), p.pick(ranked(1, 2), double, filled)
    inner = p.body({"u": x, "v": p.names[y][0]})
    name = p.define("u, v", inner, f"({_carried(p, inner, 'u')}, {_last(inner)})")
    return f"lax.scan({name}, {x}, {y}, reverse={p.chance(0.3)})[{p.integer(0, 1)}]"


def call_vmap(p):
    x, y = p.pick(ranked(1, 2, 3), filled), p.pick()
    inner = p.body({"u": p.names[x][0], "v": y})
    name = p.define("u, v", inner, _last(inner))
    return p.choice([
        f"jax.vmap({name}, (0, None), out_axes={p.choice([0, 0, -1])})({x}, {y})",
        f"lax.map(lambda u: {name}(u, {y}), {x})",
    ])  # fmt: skip


def call_derivative(p):
    x, y = p.pick(double), p.pick(double)
    inner = p.body({"u": x, "v": y})
    z = _last(inner)
    name = p.define("u, v", inner, z)
    return p.choice([
        f"jax.jvp(lambda u: {name}(u, {y}), ({x},), (jnp.cos({x}),))[1]",
        f"jax.grad(lambda u: jnp.sum({name}(u, {y})))({x})",
        f"jax.jacfwd(lambda u: {name}(u, {y}))({x})",
        f"jax.jacrev(lambda u: {name}(u, {y}))({x})",
    ])  # fmt: skip


def _last(inner):
    return list(inner.names)[-1]


def _carried(p, inner, name):
    """Text of what is like the variable `name`, and depends on what the function has found."""
    like = inner.names[name]
    found = [n for n, x in inner.names.items() if n != name and x.shape == like.shape and x.dtype == like.dtype]
    if found and p.chance(0.6):
        return found[-1]
    z = _last(inner)
    return f"jnp.tanh({name} + 0.3 * jnp.sum({z}).astype(float))"
