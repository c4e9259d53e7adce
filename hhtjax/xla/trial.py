"""A candidate for a kernel, compiled alone: XLA would fail on a whole program, of which the user knows no part."""

from functools import lru_cache
from typing import Any

from jax.extend import backend
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import func

from hhtjax.xla.inspection import callee

OPTIONS: Any = {"xla_backend_optimization_level": 0}  # less to do, the same refusals


class Module:
    """A program by itself: copies of functions, and one that calls the first of them."""

    def __init__(self, functions, names, call):
        with call.location:
            self.whole = ir.Module.create()
            self.ip = ir.InsertionPoint(self.whole.body)
            for name in names:
                functions[name].operation.clone(ip=self.ip)
            self.symbol_table = ir.SymbolTable(self.whole.operation)
            kind = ir.FunctionType.get([x.type for x in call.operands], [x.type for x in call.results])
            main = func.FuncOp("main", kind, ip=self.ip)
            with ir.InsertionPoint(main.add_entry_block()):
                reference = ir.FlatSymbolRefAttr.get(callee(call))
                self.call = func.CallOp(kind.results, reference, list(main.arguments)).operation
                func.ReturnOp(list(self.call.results))

    def refusal(self):
        """Why XLA does not compile it, in a few words; None if it does."""
        return _refusal(str(self.whole))


@lru_cache(maxsize=64)
def _refusal(text):
    try:
        client = backend.get_backend("cpu")
        options = backend.get_compile_options(num_replicas=1, num_partitions=1, env_options_overrides=OPTIONS)
        client.compile_and_load(text, client.local_devices()[:1], options)
    except Exception as error:  # whatever it is, the program runs without the kernel
        words = [*str(error).splitlines(), type(error).__name__][0]
        return words.replace('"', "'").replace("\\", "/")[:200]
    return None
