"""A suite and two policies with episodes of milliseconds, for tests; installed in a temporary
folder.
"""

from __future__ import annotations

from roboneuron import ActionSpace, BackendSpec, hookimpl


@hookimpl
def roboneuron_suites():
    from rn_eval.hooks import SuiteSpec

    return [
        SuiteSpec(
            name="toy",
            summary="Reach a point.",
            target="toy_parts:Toy",
            config="toy_parts:ToyOptions",
            robot="fr3",
        )
    ]


@hookimpl
def roboneuron_backends():
    space = ActionSpace(horizon=8, step_s=0.1)
    return [
        BackendSpec(
            name=name,
            summary="Steers.",
            target=f"toy_parts:{target}",
            needs_state=True,
            action_space=space,
        )
        for name, target in (("steer", "Steer"), ("steer-batch", "SteerBatch"))
    ]
