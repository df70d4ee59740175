"""Runs in lerobot's environment and writes scaling.json next to itself: lerobot's conversion of the
motors' raw numbers with the reference calibration, in each of its units, and back.

    .venv-lerobot/bin/python plugins/rn-robot-lerobot/tests/data/make_scaling.py
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import lerobot
from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus

from rn_robot_lerobot.bus.reference import ASSEMBLED_SO101

RAW = (900, 1500, 2047, 2048, 2500, 3100)
found = ASSEMBLED_SO101.calibration()
rows = []
for mode in MotorNormMode:
    for name, motor in found.items():
        bus = FeetechMotorsBus(
            port="none",
            motors={name: Motor(motor.id, "sts3215", mode)},
            calibration={name: MotorCalibration(**asdict(motor))},
        )
        for raw in RAW:
            value = bus._normalize({motor.id: raw})[motor.id]
            back = bus._unnormalize({motor.id: value})[motor.id]
            rows.append(
                {"mode": mode.value, "motor": name, "raw": raw, "value": value, "back": back}
            )
told = {"lerobot": lerobot.__version__, "rows": rows}
Path(__file__).with_name("scaling.json").write_text(json.dumps(told, indent=0) + "\n")
