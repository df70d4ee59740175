"""Only `roboneuron.foreign` decodes JSON and the like; trusted data are listed with the reason."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DECODERS = {
    *("json.loads", "json.load", "json.JSONDecoder", "pydantic_core.from_json"),
    *("msgpack.unpackb", "msgpack.Unpacker", "orjson.loads", "pickle.loads", "pickle.load"),
}
METHODS = {"model_validate_json", "validate_json"}
OWN_PARENT = "a pipe to a process that this one has started, or that has started it"
OWN_PROGRAM = "output of our own program, run as a child for one answer"
SHIPPED = "a file of this package, or one that rosidl has written in our own folder"
MCP = "the border of MCP: pydantic_core bounds the depth, and the schema checks the arguments"
CHECKPOINT = "a checkpoint: `reading` turns every error into CheckpointError; the size is bounded"
OPTION = "typed by the person who starts the command"
TWIN = "a simulated control box of the tests on this machine, which we have started"
TRUSTED = {
    "roboneuron-core/src/roboneuron/foreign.py": "the decoder",
    "roboneuron-core/src/roboneuron/answering_process.py": OWN_PARENT,
    "roboneuron-core/src/roboneuron/modules/module.py": OWN_PARENT,
    "roboneuron-core/src/roboneuron/server/schema.py": MCP,
    "roboneuron-core/src/roboneuron/gate/audit.py": "text that the line above has encoded",
    "roboneuron-core/src/roboneuron/plugins/loading.py": "values of the configuration",
    "roboneuron-core/src/roboneuron/plugins/availability.py": "what pip wrote of this installation",
    "rn-backend-lerobot/src/rn_backend_lerobot/tensor_file.py": CHECKPOINT,
    "rn-backend-lerobot/src/rn_backend_lerobot/loading.py": CHECKPOINT,
    "rn-backend-pi0/src/rn_backend_pi0/tensor_names.py": CHECKPOINT,
    "rn-vla/src/rn_vla/checkpoint_files.py": CHECKPOINT,
    "rn-policy-cubes/src/rn_policy_cubes/flow/packing.py": CHECKPOINT,
    "rn-policy-cubes/src/rn_policy_cubes/packing.py": CHECKPOINT,
    "rn-policy-cubes/src/rn_policy_cubes/monitor/weights.py": CHECKPOINT,
    "rn-policy-cubes/src/rn_policy_cubes/evaluation.py": "a ledger that its own child has written",
    "rn-policy-cubes/src/rn_policy_cubes/curve.py": "a curve that the training has written",
    "rn-policy-cubes/src/rn_policy_cubes/command_options.py": OPTION,
    "rn-testing/src/rn_testing/check.py": OWN_PARENT,
    "rn-testing/src/rn_testing/plugin_check.py": OWN_PROGRAM,
    "rn-testing/src/rn_testing/distribution.py": OWN_PROGRAM,
    "rn-standard/src/rn_standard/doctor/installations.py": OWN_PROGRAM,
    "rn-standard/src/rn_standard/http/sessions.py": MCP,
    "rn-standard/src/rn_standard/http/middleware.py": MCP,
    "roboneuron-core/src/roboneuron/stdio/envelope.py": MCP,
    "roboneuron-core/src/roboneuron/direct_path/exposed.py": "checked when it is read",
    "rn-standard/src/rn_standard/console/plugin_options.py": OPTION,
    "rn-runtime-sglang/src/rn_runtime_sglang/process.py": OWN_PROGRAM,
    "rn-runtime-sglang/src/rn_runtime_sglang/standin/server.py": "a stand-in for tests",
    "rn-backend-openpi/src/rn_backend_openpi/wire.py": "msgpack; `foreign.check_value` follows",
    "rn-eval/src/rn_eval/wire.py": "msgpack; `foreign.check_value` follows",
    "rn-backend-openpi/src/rn_backend_openpi/server_process.py": OWN_PARENT,
    "rn-recorder/src/rn_recorder_runs/lerobot_writer.py": OWN_PARENT,
    "rn-recorder/src/rn_recorder_runs/node.py": OWN_PARENT,
    "rn-recorder/src/rn_recorder_runs/line_pipe.py": OWN_PARENT,
    "rn-interfaces/src/rn_interfaces/asking.py": OWN_PROGRAM,
    "rn-testing/src/rn_testing/isolation.py": OWN_PROGRAM,
    "rn-eval/src/rn_eval/agents/tap.py": "a request's number that it has encoded itself",
    "rn-eval/src/rn_eval/agents/run.py": OWN_PARENT,
    "rn-eval/src/rn_eval/sharing.py": OWN_PARENT,
    "rn-eval/src/rn_eval/pools.py": OWN_PARENT,
    "rn-eval/src/rn_eval/command_plans.py": OPTION,
    "rn-eval/src/rn_eval/libero/simulator/pipe.py": OWN_PARENT,
    "rn-eval/src/rn_eval/libero/suite.py": SHIPPED,
    "rn-robot-fr3/src/rn_robot_fr3/data/franka_sim_scene.py": TWIN,
    "rn-robot-fr3/src/rn_robot_fr3/fci/arm.py": OWN_PARENT,
    "rn-robot-fr3/src/rn_robot_fr3/fci/control_process.py": OWN_PARENT,
    "rn-robot-fr3/src/rn_robot_fr3/fci/counterpart.py": TWIN,
    "rn-robot-fr3/src/rn_robot_fr3/fci/scene.py": TWIN,
}
"""Files that decode by themselves, by the reason."""


def decoding_lines(source: str) -> Iterator[int]:
    """Lines that call or name a decoder."""
    names: dict[str, str] = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            names |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
        elif isinstance(node, ast.Import):
            names |= {a.asname or a.name: a.name for a in node.names}
        elif isinstance(node, ast.Attribute):
            module = names.get(node.value.id, "") if isinstance(node.value, ast.Name) else ""
            if node.attr in METHODS or f"{module}.{node.attr}" in DECODERS:
                yield node.lineno
        elif isinstance(node, ast.Name) and names.get(node.id) in DECODERS:
            yield node.lineno


def sources() -> dict[str, Path]:
    found = [*ROOT.glob("roboneuron-core/src/**/*.py"), *ROOT.glob("plugins/*/src/**/*.py")]
    return {str(path.relative_to(ROOT)).removeprefix("plugins/"): path for path in found}


def test_foreign_data_is_decoded_in_one_place() -> None:
    breaches = [
        f"{name}:{line}"
        for name, path in sources().items()
        if name not in TRUSTED
        for line in decoding_lines(path.read_text(encoding="utf-8"))
    ]
    assert not breaches, "use roboneuron.foreign for what others have written: " + ", ".join(
        breaches
    )


def test_every_exception_is_still_needed() -> None:
    files = sources()
    unused = [
        name
        for name in TRUSTED
        if name not in files or not [*decoding_lines(files[name].read_text(encoding="utf-8"))]
    ]
    assert not unused


@pytest.mark.parametrize(
    "source",
    [
        "import json\njson.loads('1')",
        "import json as j\nj.load(f)",
        "from json import loads\nloads('1')",
        "from pydantic_core import from_json\nfrom_json(b'')",
        "M.model_validate_json('')",
        "import msgpack\nmsgpack.unpackb(b'')",
    ],
)
def test_a_decoder_is_found(source: str) -> None:
    found = [*decoding_lines(source)]
    assert found == [len(source.splitlines())]
