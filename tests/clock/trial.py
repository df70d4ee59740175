"""A moving cell on a machine whose clock is changed; run with `set_clock.c` preloaded. Prints one
line of JSON per jump.

CLOCK_OFFSET_FILE=offset LD_PRELOAD=./set_clock.so python tests/clock/trial.py FOLDER SECONDS ...
"""

from __future__ import annotations

import json
import os
import struct
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from fault_loop import moving_cell

from roboneuron.selection.requests import StartChosenInference
from roboneuron.switching.replacing import Switching

sys.path.pop(0)
_RECOVER_S = 20.0


def main(folder: Path, jumps_s: list[float]) -> None:
    offset = Path(os.environ["CLOCK_OFFSET_FILE"])
    with moving_cell(folder, 10.0) as (loop, witness):
        switching = Switching(loop)

        def health() -> dict[str, str]:
            return {view.kind: view.health(time.monotonic()) for view in loop.modules.views()}

        def settled() -> bool:
            return witness.moves() and set(health().values()) == {"ok"}

        def wait(fact: object, timeout_s: float) -> float | None:
            started_s = time.monotonic()
            while not fact():  # type: ignore[operator]
                if time.monotonic() - started_s > timeout_s:
                    return None
                time.sleep(0.01)
            return time.monotonic() - started_s

        wait(settled, 20.0)
        switching.switch("inference", StartChosenInference(backend="first"))  # records moments
        wait(settled, 20.0)
        now_s = 0.0
        for jump_s in jumps_s:
            now_s += jump_s
            before_ns, began_s = time.time_ns(), time.monotonic()
            with offset.open("r+b") as file:
                file.write(struct.pack("q", int(now_s * 1e9)))
            seen_s = (time.time_ns() - before_ns) / 1e9
            time.sleep(1.5)
            recovered_s = wait(settled, _RECOVER_S)
            pids = {view.kind: view.process.pid for view in loop.modules.views() if view.process}
            step_m = witness.largest_step_m(began_s)
            print(
                json.dumps(
                    {
                        "jump_s": jump_s,
                        "seen_s": round(seen_s, 1),
                        "recovered_s": recovered_s,
                        "health": health(),
                        "largest_step_m": step_m,
                        "pids": pids,
                    }
                ),
                flush=True,
            )
        switching.switch("inference", StartChosenInference(backend="first"))
        print(json.dumps({"switched": wait(settled, 20.0) is not None}), flush=True)
        print(json.dumps({"stopped": [s.exit_code for s in loop.stop_all()]}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), [float(text) for text in sys.argv[2:]])
