"""Which mutants tools/mutations.py makes: those of mutmut, three more, and none that only changes a
text for people.

Added to mutmut's: a `raise` that is left out, a call that is left out where nothing uses its
result, and an `if` whose condition is inverted.

Left out, by rule: a literal with a letter and a blank in it and an f-string with a blank (codes,
keys and names of rules have none), what is put together with one (`+`, `x if y else z`, `",
".join(...)`), arguments, variables and attributes called as in TEXT_NAMES, a variable `text` that
an exception called ...Error is given, and calls of a logger or of print. Docstrings are left out by
mutmut.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Iterator

import libcst as cst
from mutmut.mutation import file_mutation, mutators

TEXT_NAMES = frozenset({"hint", "note", "reason"})
"""Arguments, variables and attributes that hold a text for people, wherever they occur."""
UNWRAPPED = frozenset({"contextmanager", "property"})
"""Decorators that can be called after the function is made: mutmut makes no mutants of a decorated
function.
"""
_SAME_AS_INVERTED = (cst.Equal, cst.NotEqual, cst.Is, cst.IsNot, cst.In, cst.NotIn)
"""Comparisons that mutmut inverts itself."""
_Operator = Callable[[cst.CSTNode], Iterable[cst.CSTNode]]


def install() -> None:
    """Have mutmut make the mutants described above, in this process and those that it forks."""
    mutators.mutation_operators[:] = [
        *((kind, _about_behaviour(operator)) for kind, operator in mutators.mutation_operators),
        (cst.Raise, _leave_out),
        (cst.Expr, _leave_out_call),
        (cst.If, _invert_condition),
        (cst.CompIf, _invert_condition),
    ]
    file_mutation.MutationVisitor = BehaviourVisitor


class BehaviourVisitor(file_mutation.MutationVisitor):
    """Passes over texts for people."""

    def _skip_node_and_children(self, node: cst.CSTNode) -> bool:
        return is_text(node) or _is_log_call(node) or bool(super()._skip_node_and_children(node))


def is_text(node: cst.CSTNode) -> bool:
    """Whether an expression or argument makes a text for people, by the rule in this module's
    docstring.
    """
    match node:
        case cst.SimpleString():
            return " " in node.value and any(sign.isalpha() for sign in node.value)
        case cst.FormattedString():
            return any(
                isinstance(part, cst.FormattedStringText) and " " in part.value
                for part in node.parts
            )
        case cst.ConcatenatedString() | cst.BinaryOperation():
            return is_text(node.left) or is_text(node.right)
        case cst.IfExp():
            return is_text(node.body) or is_text(node.orelse)
        case cst.Call(func=cst.Attribute(value=cst.SimpleString(value=owner))):
            return " " in owner
        case cst.Subscript():
            return is_text(node.value)
        case cst.Arg():
            return (node.keyword is not None and is_text(node.keyword)) or is_text(node.value)
        case cst.Name():
            return node.value in TEXT_NAMES
        case cst.Attribute():
            return is_text(node.attr)
    return False


def unwrap_decorators(source: str) -> str:
    """The same module with `@property` and `@contextmanager` applied by a call after the function;
    lines stay.
    """
    lines = source.splitlines()
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    for function in sorted(functions, key=lambda node: node.lineno, reverse=True):
        if len(function.decorator_list) != 1:
            continue
        decorator = function.decorator_list[0]
        written = ast.unparse(decorator)
        if written.rpartition(".")[2] not in UNWRAPPED or function.end_lineno is None:
            continue
        lines.insert(
            function.end_lineno,
            f"{' ' * function.col_offset}{function.name} = {written}({function.name})",
        )
        del lines[decorator.lineno - 1]
    return "\n".join(lines) + "\n"


def _about_behaviour(operator: _Operator) -> _Operator:
    def mutants(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
        for mutated in operator(node):
            if not _changes_only_text(node, mutated):
                yield mutated

    return mutants


def _changes_only_text(node: cst.CSTNode, mutated: cst.CSTNode) -> bool:
    """Whether a mutant replaces or drops nothing but texts: an argument, or what is assigned."""
    if isinstance(node, cst.Call) and isinstance(mutated, cst.Call):
        kept = {id(argument) for argument in mutated.args}
        lost = [argument for argument in node.args if id(argument) not in kept]
        is_error = isinstance(node.func, cst.Name) and node.func.value.endswith("Error")
        return bool(lost) and all(
            is_text(one) or (is_error and _is_called(one.value, "text")) for one in lost
        )
    if isinstance(node, cst.Assign):
        return is_text(node.value) or all(is_text(target.target) for target in node.targets)
    if isinstance(node, cst.AnnAssign):
        return is_text(node.target) or (node.value is not None and is_text(node.value))
    return False


def _is_called(node: cst.CSTNode, name: str) -> bool:
    return isinstance(node, cst.Name) and node.value == name


def _is_log_call(node: cst.CSTNode) -> bool:
    match node:
        case cst.Call(func=cst.Name(value="print")):
            return True
        case cst.Call(
            func=cst.Attribute(
                value=cst.Name(value=owner) | cst.Attribute(attr=cst.Name(value=owner))
            )
        ):
            return owner.strip("_") in ("log", "logger")
    return False


def _leave_out(node: cst.Raise) -> Iterator[cst.CSTNode]:
    yield cst.Pass(semicolon=node.semicolon)


def _leave_out_call(node: cst.Expr) -> Iterator[cst.CSTNode]:
    call = node.value.expression if isinstance(node.value, cst.Await) else node.value
    if isinstance(call, cst.Call) and not _is_log_call(call):
        yield cst.Pass(semicolon=node.semicolon)


def _invert_condition(node: cst.If | cst.CompIf) -> Iterator[cst.CSTNode]:
    test = node.test
    if isinstance(test, cst.UnaryOperation) and isinstance(test.operator, cst.Not):
        return
    is_one = isinstance(test, cst.Comparison) and len(test.comparisons) == 1
    if is_one and isinstance(test.comparisons[0].operator, _SAME_AS_INVERTED):
        return
    bracketed = test.with_changes(lpar=[cst.LeftParen()], rpar=[cst.RightParen()])
    inverted = cst.UnaryOperation(operator=cst.Not(), expression=bracketed)
    yield node.with_changes(test=inverted, **_space_before_test(node))


def _space_before_test(node: cst.If | cst.CompIf) -> dict[str, cst.BaseParenthesizableWhitespace]:
    """A blank after `if`, which may be missing before a bracket."""
    return {"whitespace_before_test": cst.SimpleWhitespace(" ")}
