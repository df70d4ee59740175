"""Mutation operators of tools/mutations.py: those of mutmut and three more, without mutants that
only change a text for people.

Added to mutmut's: removal of a `raise`, removal of a call whose result is unused, and inversion of
an `if` condition.

Excluded as texts: a literal with a letter and a blank and an f-string with a blank (codes, keys and
names of rules have none), expressions composed with one (`+`, `x if y else z`, `", ".join(...)`),
arguments, variables and attributes named as in TEXT_NAMES, a variable `text` passed to an exception
named ...Error, and calls of a logger or of print. mutmut itself excludes docstrings.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Iterator

import libcst as cst
from mutmut.mutation import file_mutation, mutators

TEXT_NAMES = frozenset({"hint", "note", "reason"})
"""Names of arguments, variables and attributes with texts for people."""
UNWRAPPED = frozenset({"contextmanager", "property"})
"""Decorators that can be applied after the function is defined, because mutmut makes no mutants of
decorated functions.
"""
_SAME_AS_INVERTED = (cst.Equal, cst.NotEqual, cst.Is, cst.IsNot, cst.In, cst.NotIn)
"""Comparisons that mutmut inverts itself."""
_Operator = Callable[[cst.CSTNode], Iterable[cst.CSTNode]]


def install() -> None:
    """Install the mutation operators described above in mutmut, for this process and its forks."""
    mutators.mutation_operators[:] = [
        *((kind, _about_behaviour(operator)) for kind, operator in mutators.mutation_operators),
        (cst.Raise, _leave_out),
        (cst.Expr, _leave_out_call),
        (cst.If, _invert_condition),
        (cst.CompIf, _invert_condition),
    ]
    file_mutation.MutationVisitor = BehaviourVisitor


class BehaviourVisitor(file_mutation.MutationVisitor):
    """Skips texts for people."""

    def _skip_node_and_children(self, node: cst.CSTNode) -> bool:
        return is_text(node) or _is_log_call(node) or bool(super()._skip_node_and_children(node))


def is_text(node: cst.CSTNode) -> bool:
    """True if an expression or argument is a text for people, by the rule in this module's
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
    line numbers stay the same.
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
    """True if a mutant only replaces or drops texts: an argument, or an assigned value."""
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
    """A blank after `if`, which may be missing before a parenthesis."""
    return {"whitespace_before_test": cst.SimpleWhitespace(" ")}
