"""Example predicates to copy, as JSON values."""

from __future__ import annotations

EXAMPLES: dict[str, dict[str, object]] = {
    "the red cube is lifted and held for a second": {
        "kind": "held",
        "for_s": 1.0,
        "of": {
            "kind": "all",
            "of": [
                {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.85},
                {
                    "kind": "monitor",
                    "name": "colour-lifted",
                    "options": {"colour": "red", "height_m": 0.1},
                },
            ],
        },
    },
    "the blue cube lies in a box on the table": {
        "kind": "monitor",
        "name": "object-in-region",
        "options": {"colour": "blue", "lower_m": [0.4, 0.1, 0.0], "upper_m": [0.6, 0.3, 0.1]},
    },
    "the arm is over the table and stands": {
        "kind": "all",
        "of": [
            {"kind": "tcp_in", "lower_m": [0.3, -0.3, 0.2], "upper_m": [0.7, 0.3, 0.6]},
            {"kind": "still", "for_s": 0.5},
        ],
    },
    "the policy says that it has finished": {"kind": "policy_done"},
    "the temperature is below 60": {
        "kind": "field",
        "topic": "motor_temperature",
        "type": "std_msgs/msg/Float64",
        "field": "data",
        "at_most": 60.0,
    },
}
"""Predicate by its meaning."""
