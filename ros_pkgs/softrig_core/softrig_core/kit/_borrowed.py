"""A pass of numba's compiler that omits reference counts in functions that only read their array arguments.

Each count is a call with an atomic addition, and all numbers leave their registers before and after it. In a loop of a
few operations that is half of the time. The caller must hold the arrays until the function has returned.
"""

# mypy: allow-untyped-calls

from __future__ import annotations

from typing import Any

from numba.core import ir, types
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.errors import NumbaRuntimeError
from numba.core.typed_passes import NoPythonSupportedFeatureValidation

# These expressions return a part of a tuple, which exists already and is counted by its caller.
OF_TUPLES = frozenset({"static_getitem", "exhaust_iter", "getattr"})


@register_pass(mutates_CFG=False, analysis_only=True)
class Borrowed(FunctionPass):  # type: ignore[misc, unused-ignore]
    """Lets a function that creates and returns no counted object be compiled without reference counting."""

    _name = "softrig_borrowed"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Decide whether a typed function needs reference counts; the function itself is not changed."""
        if not state.func_ir.is_generator and not any(self._counted(state, created) for created in self._made(state)):
            state.targetctx = state.targetctx.subtarget(enable_nrt=False)
            # The previous context would still count; without it numba refuses a function that allocates after all.
            vars(state.targetctx).pop("nrt", None)
        return False

    def _made(self, state: Any) -> list[Any]:
        """Return the types of its results, and of values that are no part of its arguments."""
        result = [state.return_type]
        for block in state.func_ir.blocks.values():
            for assigned in block.find_insts(ir.Assign):
                value = assigned.value
                if isinstance(value, ir.Yield) or (isinstance(value, ir.Expr) and not self._part(state, value)):
                    result.append(state.typemap[assigned.target.name])
        return result

    @staticmethod
    def _part(state: Any, value: Any) -> bool:
        if value.op in OF_TUPLES:
            return isinstance(state.typemap[value.value.name], types.BaseTuple)
        return value.op in ("build_tuple", "cast")

    @staticmethod
    def _counted(state: Any, kind: Any) -> bool:
        return bool(state.targetctx.data_model_manager[kind].contains_nrt_meminfo())


class Borrowing(Compiler):  # type: ignore[misc, unused-ignore]
    """numba's compiler with that pass, except for functions that create temporary arrays."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._arguments = arguments

    def compile_extra(self, func: Any) -> Any:
        """Compile a function."""
        try:
            return super().compile_extra(func)
        except NumbaRuntimeError:
            # The function makes arrays although it returns none, so it is compiled again with counting.
            return Compiler(*self._arguments).compile_extra(func)

    def define_pipelines(self) -> list[Any]:
        """Return numba's pipelines with the pass added."""
        result: list[Any] = super().define_pipelines()
        for pipeline in result:
            # The step needs the types that numba has inferred, and must come before the code is lowered.
            if any(step is NoPythonSupportedFeatureValidation for step, _ in pipeline.passes):
                pipeline.add_pass_after(Borrowed, NoPythonSupportedFeatureValidation)
                pipeline.finalize()
        return result
