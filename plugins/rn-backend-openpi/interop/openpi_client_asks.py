"""The published openpi-client with RoboNeuron's server; run by its own interpreter, without
RoboNeuron.

    python openpi_client_asks.py URL REQUESTS.npz ANSWERS.npz [KEY]

Each request is an array of the first file: `<number>/<key of the request>`; texts are arrays of one
text. Answers are written in the same form, with `metadata` as text.
"""

from __future__ import annotations

import sys
from collections import defaultdict

import numpy as np
from openpi_client import image_tools
from openpi_client.websocket_client_policy import WebsocketClientPolicy


def main(url: str, requests: str, answers: str, key: str | None = None) -> None:
    """Send each request and write the answers."""
    asked: dict[str, dict[str, object]] = defaultdict(dict)
    with np.load(requests) as arrays:
        for name in arrays.files:
            number, _, entry = name.partition("|")
            value = arrays[name]
            if value.dtype.kind == "U":
                asked[number][entry] = str(value)
            elif value.ndim == 3:
                fitted = image_tools.resize_with_pad(value, 224, 224)
                asked[number][entry] = image_tools.convert_to_uint8(fitted)
            else:
                asked[number][entry] = value
    policy = WebsocketClientPolicy(host=url, api_key=key)
    told: dict[str, object] = {"metadata": np.array(repr(policy.get_server_metadata()))}
    for number, request in asked.items():
        reply = policy.infer(request)
        told[f"{number}|actions"] = reply["actions"]
        told[f"{number}|infer_ms"] = np.array(reply["server_timing"]["infer_ms"])
    try:
        policy.infer({"prompt": "nothing else"})
    except RuntimeError as error:
        told["refused"] = np.array(str(error))
    np.savez(answers, **told)  # type: ignore[arg-type]


if __name__ == "__main__":
    main(*sys.argv[1:])
