"""Which parameters of an operation the rules of this folder understand: with any other, it runs on whole arrays.

So a parameter, or a value of one, that a later JAX brings makes programs slower, and never wrong.
"""

from jax import lax

ELEMENTWISE = {
    *("abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil"),
    *("bitcast_convert_type", "clamp", "convert_element_type", "copy", "cos", "cosh", "div", "eq", "erf", "exp"),
    *("exp2", "expm1", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt", "max"),
    *("min", "mul", "ne", "neg", "nextafter", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign"),
    *("sin", "sinh", "sqrt", "square", "stop_gradient", "sub", "tan", "tanh", "xor"),
}


def _any(value):
    return True


def _none(value):
    return value is None


def _own(sharding):
    """None, or what shard_map says of arrays that each device has to itself."""
    return sharding is None or (
        getattr(getattr(sharding, "mesh", None), "are_all_axes_manual", False) and not any(sharding.spec)
    )


def _empty(value):
    return not value


def _unspecified(values):
    return all(type(x).__name__ == "UnspecifiedValue" for x in values)


def _no_layout(values):
    return all(x is None for x in values)


def _usual_precision(value):
    """What the CPU computes in any case: full precision."""
    values = value if isinstance(value, tuple) else (value,)
    return all(x is None or isinstance(x, lax.Precision) for x in values)


def _mode(value):
    modes = lax.GatherScatterMode
    return value in (modes.CLIP, modes.FILL_OR_DROP, modes.PROMISE_IN_BOUNDS)


def replaces(jaxpr):
    """Whether an update of a scatter takes the place of what was there; others compute with both."""
    if jaxpr is None:
        return True
    jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
    return not jaxpr.eqns and list(jaxpr.outvars) == [jaxpr.invars[1]]


def _of_any(*names):
    return dict.fromkeys(names, _any)


_GATHERED = {**_of_any("dimension_numbers", "unique_indices", "indices_are_sorted"), "mode": _mode}
_SUM = {"axes": _any, "out_sharding": _none}
UNDERSTOOD = {
    **{name: {"accuracy": _none} for name in ELEMENTWISE},
    "bitcast_convert_type": _of_any("new_dtype"),
    "convert_element_type": {**_of_any("new_dtype", "weak_type"), "sharding": _none},
    "integer_pow": _of_any("y"),
    "mul": {"out_dtype": _none},
    "round": _of_any("rounding_method"),
    "broadcast_in_dim": {**_of_any("shape", "broadcast_dimensions"), "sharding": _own},
    "concatenate": _of_any("dimension"),
    "dot_general": {
        **{"dimension_numbers": _any, "precision": _usual_precision, "preferred_element_type": _any},
        "out_sharding": _none,
    },
    "dynamic_slice": _of_any("slice_sizes"),
    "dynamic_update_slice": {},
    "gather": {**_GATHERED, **_of_any("slice_sizes", "fill_value")},
    "iota": {**_of_any("dtype", "shape", "dimension"), "sharding": _own},
    "pad": _of_any("padding_config"),
    **{f"reduce_{kind}": _SUM for kind in ("sum", "prod", "max", "min", "and", "or")},
    "reshape": {**_of_any("new_sizes", "dimensions"), "sharding": _none},
    "rev": _of_any("dimensions"),
    "scatter": {**_GATHERED, "update_jaxpr": replaces, "update_consts": _empty},
    "slice": _of_any("start_indices", "limit_indices", "strides"),
    "split": _of_any("sizes", "axis"),
    "squeeze": _of_any("dimensions"),
    "stack": _of_any("axis"),
    "transpose": _of_any("permutation"),
    "unstack": _of_any("axis"),
    "cond": _of_any("branches"),
    "while": _of_any("cond_nconsts", "cond_jaxpr", "body_nconsts", "body_jaxpr"),
    "custom_linear_solve": _of_any("const_lengths", "jaxprs"),
    "custom_jvp_call": {**_of_any("call_jaxpr", "jvp_jaxpr_fun", "num_consts"), "symbolic_zeros": _empty},
    "jit": {
        **_of_any("jaxpr", "name", "donated_invars", "keep_unused", "inline"),
        **dict.fromkeys(("in_shardings", "out_shardings"), _unspecified),
        **dict.fromkeys(("in_layouts", "out_layouts"), _no_layout),
        **{"ctx_mesh": lambda mesh: mesh.empty, "compiler_options_kvs": _empty},
    },
    "hhtjax_in_turn": _of_any("closed", "at_once", "number"),
    "hhtjax_held": {},
    "hhtjax_structural": {},
    "hhtjax_family": _of_any("n", "family", "jaxpr"),
    "hhtjax_bilinear": _of_any("product", "jaxpr"),
    "hhtjax_largest_in_batch": _of_any("kept"),
}


def is_understood(eqn):
    """Whether all parameters of an operation are known, with values for which its rules were written."""
    known = UNDERSTOOD.get(eqn.primitive.name)
    return known is not None and all(name in known and known[name](x) for name, x in eqn.params.items())
