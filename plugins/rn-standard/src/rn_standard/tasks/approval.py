"""Approval of a call by a person, where configured."""

from __future__ import annotations

from rn_standard.tasks.options import TaskOptions
from roboneuron import CallContext, RefusedError, foreign

_MOST = 2000


class Approval:
    """Asks the user of a client, for the configured tools and roles."""

    def __init__(self, options: TaskOptions) -> None:
        self._options = options

    async def ask(self, tool: str, doing: str, words: str, context: CallContext) -> None:
        """Return if no approval is needed, or a person agreed; called before anything takes effect.

        Args:
            tool: its name.
            doing: what the robot would do, such as "carry out".
            words: with what, as an agent wrote it.
            context: of the call.

        Raises:
            RefusedError: the person refused or did not answer, or the client cannot ask.
        """
        if tool not in self._options.approval or context.role not in self._options.approval_roles:
            return
        agreed = await context.ask(f"Let the robot {doing} {foreign.quoted(words, _MOST)}?")
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
