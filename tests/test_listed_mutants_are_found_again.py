"""tools/mutation_survivors.toml identifies a mutant by the statement that it changes."""

from __future__ import annotations

from mutation_identity import describe_change

WIDE = """\
def stop(names, timeout_s):
    if names and timeout_s > 0.0:  # nothing to wait for
        end(names, timeout_s=timeout_s, kill=True)
"""
NARROW = """\
def stop(
    names,
    timeout_s,
):
    if (
        names
        and timeout_s > 0.0
    ):
        # nothing to wait for
        end(
            names,
            timeout_s=timeout_s,
            kill=True,
        )
"""


def test_a_mutant_keeps_its_name_when_lines_are_broken_elsewhere() -> None:
    change = describe_change(WIDE, WIDE.replace("True", "False"))
    assert change == (
        "end(names, timeout_s=timeout_s, kill=True) -> end(names, timeout_s=timeout_s, kill=False)"
    )
    assert describe_change(NARROW, NARROW.replace("True", "False")) == change


def test_a_mutant_is_named_by_the_changed_statement_alone() -> None:
    change = describe_change(WIDE, WIDE.replace("> 0.0", ">= 0.0"))
    assert change == "if names and timeout_s > 0.0: -> if names and timeout_s >= 0.0:"


def test_a_method_is_read_with_its_indentation() -> None:
    docstring = '"""Hold,\n\nthen leave."""'
    method = (
        f"\n    # held first\n    def stop(self):\n        {docstring}\n        self.held = True\n"
    )
    change = describe_change(method, method.replace("True", "None"))
    assert change == "self.held = True -> self.held = None"


def test_other_mutants_of_a_statement_have_other_names() -> None:
    changes = {
        describe_change(WIDE, WIDE.replace(old, new))
        for old, new in (("and", "or"), ("0.0", "1.0"), ("> 0", ">= 0"), ("True", "None"))
    }
    assert len(changes) == 4


def test_a_removed_keyword_and_a_changed_default_are_seen() -> None:
    assert describe_change(NARROW, NARROW.replace("            kill=True,\n", "")).endswith(
        "-> end(names, timeout_s=timeout_s)"
    )
    change = describe_change("def hold(s=1.0):\n    pass\n", "def hold(s=2.0):\n    pass\n")
    assert change == "def hold(s=1.0): -> def hold(s=2.0):"
