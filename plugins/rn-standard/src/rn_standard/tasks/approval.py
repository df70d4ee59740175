"""A person's approval of a call, where the configuration asks for it."""

from __future__ import annotations

from rn_standard.tasks.options import TaskOptions
from roboneuron import CallContext, RefusedError


class Approval:
    """Asks the person behind a client, for the tools and roles that the configuration names."""

    def __init__(self, options: TaskOptions) -> None:
        self._options = options

    async def ask(self, tool: str, question: str, context: CallContext) -> None:
        """Return when nobody needs to be asked, or a person agreed; called before anything has an
        effect.

        Raises:
            RefusedError: the person said no, did not answer, or the client cannot ask one.
        """
        if tool not in self._options.approval or context.role not in self._options.approval_roles:
            return
        agreed = await context.ask(question)
        if agreed is None:
            raise RefusedError(
                f"A person must approve {tool} for the role {context.role!r}, and this client "
                "cannot ask one.",
                hint="Use a client that supports elicitation, or a role that is not in "
                "approval_roles of [tasks].",
                rule="person",
            )
        if not agreed:
            raise RefusedError(f"A person did not approve {tool}.", rule="person")
