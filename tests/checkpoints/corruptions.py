"""Damaged checkpoints by the hundred: made, loaded and run under limits of memory and time, in a process of their own.

    corruptions.py LAYOUT DIRECTORY [STRIDE]

Writes a tiny checkpoint of LAYOUT into DIRECTORY, damages a copy for every case (or every STRIDE-th), and prints one
JSON object per case.
"""

from __future__ import annotations

import copy
import itertools
import json
import os
import pickle
import resource
import shutil
import signal
import struct
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

SECONDS = 20
"""A case that takes longer is stopped; loading a tiny checkpoint takes well under a second."""
GROWTH_BYTES = 2 * 2**30
"""Address space that a case may add."""
Damage = Callable[[Path], None]
Case = tuple[str, Damage]

JSON_FILES = {
    "openvla": ["config.json", "preprocessor_config.json", "tokenizer.json", "model.safetensors.index.json"],
    "oft": [
        "config.json",
        "preprocessor_config.json",
        "dataset_statistics.json",
        "tokenizer.json",
        "model.safetensors.index.json",
    ],
    "pi0-lerobot": ["config.json", "policy_preprocessor.json", "policy_postprocessor.json", "tokenizer.json"],
    "pi0-openpi": ["config.json", "assets/tiny/norm_stats.json", "tokenizer.json"],
}
WEIGHT_FILES = {
    "openvla": ["model-00001-of-00002.safetensors"],
    "oft": ["model-00002-of-00002.safetensors"],
    "pi0-lerobot": [
        "model.safetensors",
        "policy_preprocessor_step_5_normalizer_processor.safetensors",
        "policy_postprocessor_step_0_unnormalizer_processor.safetensors",
    ],
    "pi0-openpi": ["model.safetensors"],
}
HEADS = {"oft": ["action_head--1_checkpoint.pt", "proprio_projector--1_checkpoint.pt"]}
NUMBERS: dict[type, list[object]] = {
    int: [-64, -1, 0, 7 * 10**8, 2 * 10**9, 10**30, 1e308, "x", True, [], {}],
    float: [-1.0, 1e-300, 1e9, 1e308, float("nan"), float("-inf"), "x", [], {}],
}
"""What a number is replaced by."""
MEANT = {
    "q01.0 = 1e-300",
    "q99.0 = 1e-300",
    "max.0 = 1e-300",
    "min.0 = 1e-300",
    "q01.0 = -1.0",
    "q99.0 = -1.0",
    "mean.0 = 1e-300",
    "norm_stats.state.mean.0 = -1.0",
    "norm_stats.actions.mean.0 = -1.0",
}
"""Endings of replacements that another checkpoint could mean, so that nothing tells them from a right one."""


def make(layout: str, directory: Path) -> None:
    """Write a tiny checkpoint."""
    if layout.startswith("pi0"):
        from rn_backend_pi0.tiny import make_tiny as make_pi0

        make_pi0(directory, layout="openpi" if layout == "pi0-openpi" else "lerobot")
    elif layout == "oft":
        from rn_backend_oft.tiny import make_tiny_oft

        make_tiny_oft(directory)
    else:
        from rn_backend_openvla.tiny import make_tiny

        make_tiny(directory)


def act(layout: str, directory: Path) -> list[float]:
    """The action of a checkpoint for one fixed observation."""
    import numpy as np

    from roboneuron.contract import Frame, Observation, Pose

    picture = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    frames = {role: Frame(camera=role, image=picture, stamp_ns=1, frame_id=role) for role in ("primary", "wrist")}
    observation = Observation(
        frames=frames,
        instruction="pick up the red cube and put it on the blue plate",
        ee_pose=Pose(position_m=np.array([0.4, 0.0, 0.5]), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0])),
        gripper_open=0.5,
    )
    backend = _backend(layout, directory)
    try:
        backend.load()
        return [float(value) for value in backend.predict(observation).actions.ravel()]
    finally:
        backend.close()


def _backend(layout: str, directory: Path) -> Any:
    if layout.startswith("pi0"):
        from rn_backend_pi0.native import Pi0Backend
        from rn_backend_pi0.options import Pi0Options

        return Pi0Backend(Pi0Options(checkpoint=directory, device="cpu", profile="libero"))
    from rn_runtime_torch.config import TorchRuntimeConfig
    from rn_runtime_torch.runtime import TorchRuntime

    runtime = TorchRuntime(TorchRuntimeConfig(device="cpu"))
    if layout == "oft":
        from rn_backend_oft.backend import OftBackend
        from rn_backend_oft.config import OftConfig

        config = OftConfig(checkpoint=directory, profile="libero", constants="libero", proprio=True)
        return OftBackend(config, runtime=runtime)
    from rn_backend_openvla.backend import OpenVlaBackend
    from rn_backend_openvla.config import OpenVlaConfig

    return OpenVlaBackend(OpenVlaConfig(checkpoint=directory, profile="libero"), runtime=runtime)


def cases(layout: str, original: Path) -> Iterator[Case]:
    """Every damage to one layout."""
    for name in JSON_FILES[layout]:
        yield from _files(name)
        yield from _texts(name)
    for name in JSON_FILES[layout]:
        if name != "tokenizer.json" and not name.endswith("index.json"):
            yield from _numbers(name, json.loads((original / name).read_text()))
    yield from _tokenizers()
    for name in WEIGHT_FILES[layout]:
        yield from _files(name)
        yield from _safetensors(name)
    for name in HEADS.get(layout, []):
        yield from _files(name)
        yield from _pickles(name)
    yield from _SPECIAL[layout]()


def _files(name: str) -> Iterator[Case]:
    def replaced(make_it: Callable[[Path], object]) -> Damage:
        def damage(directory: Path) -> None:
            (directory / name).unlink()
            make_it(directory / name)

        return damage

    yield f"{name}: absent", replaced(lambda path: None)
    yield f"{name}: empty", replaced(lambda path: path.write_bytes(b""))
    yield f"{name}: a pipe", replaced(os.mkfifo)
    yield f"{name}: a directory", replaced(lambda path: path.mkdir())
    yield f"{name}: an endless device", replaced(lambda path: path.symlink_to("/dev/zero"))
    yield f"{name}: a link to nothing", replaced(lambda path: path.symlink_to("nowhere"))
    yield f"{name}: a hundred gigabytes of zeros", replaced(lambda path: _sparse(path, 100 * 10**9))
    yield f"{name}: random bytes", replaced(lambda path: path.write_bytes(bytes(range(255, -1, -1)) * 64))


def _sparse(path: Path, size: int) -> None:
    with path.open("wb") as file:
        file.truncate(size)


def _texts(name: str) -> Iterator[Case]:
    texts = {
        "null": "null",
        "a list": "[]",
        "an empty object": "{}",
        "a text": '"text"',
        "half": '{"half": ',
        "deep objects": '{"a":' * 200_000 + "1" + "}" * 200_000,
        "deep lists": "[" * 500_000,
        "a number of a million digits": '{"a": ' + "9" * 1_000_000 + "}",
        "wide lists": '{"a": [' + "[]," * 1_000_000 + "[]]}",
        "a name of 7 MB": json.dumps({"n" * 7_000_000: 1}),
        "not UTF-8": '{"a": "\udcff"}',
    }
    for what, text in texts.items():
        yield f"{name}: {what}", _writer(name, text.encode("utf-8", "surrogateescape"))


def _writer(name: str, data: bytes) -> Damage:
    def damage(directory: Path) -> None:
        (directory / name).write_bytes(data)

    return damage


def _edited(name: str, edit: Callable[[Any], object]) -> Damage:
    def damage(directory: Path) -> None:
        document = json.loads((directory / name).read_text())
        edit(document)
        (directory / name).write_text(json.dumps(document))

    return damage


def _leaves(value: object, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], object]]:
    """Every number; of a list of numbers, the first one."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _leaves(part, (*path, key))
    elif isinstance(value, list):
        for index, part in enumerate(value):
            if index == 0 or isinstance(part, dict | list):
                yield from _leaves(part, (*path, index))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, value


def _place(document: Any, path: tuple[Any, ...], value: object) -> None:
    for key in path[:-1]:
        document = document[key]
    document[path[-1]] = copy.deepcopy(value)


def _numbers(name: str, document: object) -> Iterator[Case]:
    for path, old in _leaves(document):
        for value in NUMBERS[type(old)]:
            where = f"{'.'.join(map(str, path))} = {value!r}"
            if where.endswith(tuple(MEANT)):
                continue
            yield f"{name}: {where}", _edited(name, lambda d, p=path, v=value: _place(d, p, v))


def _tokenizers() -> Iterator[Case]:
    name = "tokenizer.json"
    cut = {"direction": "Right", "max_length": 4, "strategy": "LongestFirst", "stride": 0}
    pad = {"strategy": {"Fixed": 60}, "direction": "Right", "pad_to_multiple_of": None}
    pad |= {"pad_id": 0, "pad_type_id": 0, "pad_token": "<unk>"}
    added = {"id": 10**6, "content": "zebra", "single_word": False, "lstrip": False, "rstrip": False}
    added |= {"normalized": False, "special": False}
    yield "tokenizer.json: truncation", _edited(name, lambda d: d.update(truncation=cut))
    yield "tokenizer.json: padding", _edited(name, lambda d: d.update(padding=pad))
    yield "tokenizer.json: an added id of a million", _edited(name, lambda d: d["added_tokens"].append(added))
    many = [added | {"content": f"zebra{i}"} for i in range(1000)]
    yield "tokenizer.json: a thousand added ids", _edited(name, lambda d: d["added_tokens"].extend(many))

    def beyond(document: Any) -> None:
        vocabulary = document["model"]["vocab"]
        vocabulary[next(reversed(vocabulary))] = 3_000_000

    yield "tokenizer.json: an id of three millions", _edited(name, beyond)
    yield "tokenizer.json: a negative id", _edited(name, lambda d: d["model"]["vocab"].update(zz=-4))


def _safetensors(name: str) -> Iterator[Case]:
    def header(edit: Callable[[dict[str, Any]], object]) -> Damage:
        def damage(directory: Path) -> None:
            data = (directory / name).read_bytes()
            length = int.from_bytes(data[:8], "little")
            content = json.loads(data[8 : 8 + length])
            edit(content)
            raw = json.dumps(content).encode()
            (directory / name).write_bytes(len(raw).to_bytes(8, "little") + raw + data[8 + length :])

        return damage

    def tensors(edit: Callable[[dict[str, Any]], object]) -> Damage:
        def damage(directory: Path) -> None:
            from safetensors.torch import load_file, save_file

            content = load_file(directory / name)
            edit(content)
            save_file(content, directory / name)

        return damage

    def each(content: dict[str, Any]) -> list[dict[str, Any]]:
        return [entry for key, entry in content.items() if key != "__metadata__"]

    def cast(kind: str) -> Damage:
        def edit(content: dict[str, Any]) -> None:
            import torch

            for key in content:
                content[key] = content[key].to(getattr(torch, kind))

        return tensors(edit)

    def first(value: float) -> Damage:
        return tensors(lambda content: content[max(content)].view(-1)[0].fill_(value))

    yield f"{name}: truncated", lambda d: os.truncate(d / name, (d / name).stat().st_size - 10)
    for length in (0, 1, 2**31, 2**63, 2**64 - 1):
        yield f"{name}: a header of {length} bytes", _overwrite(name, struct.pack("<Q", length))
    yield f"{name}: deep header", _writer(name, struct.pack("<Q", 10**6) + b"[" * 10**6)
    yield f"{name}: shape", header(lambda h: each(h)[0].update(shape=[2**40, 2**20]))
    yield f"{name}: negative shape", header(lambda h: each(h)[0].update(shape=[-1]))
    yield f"{name}: offsets", header(lambda h: each(h)[0].update(data_offsets=[0, 2**60]))
    yield f"{name}: overlap", header(lambda h: each(h)[1].update(data_offsets=each(h)[0]["data_offsets"]))
    yield f"{name}: number type", header(lambda h: each(h)[0].update(dtype="X9"))
    for kind in ("int64", "int8", "uint8", "bool", "complex64"):
        yield f"{name}: all {kind}", cast(kind)
    for value in (float("nan"), float("inf")):
        yield f"{name}: {value} inside", first(value)
    yield (
        f"{name}: a name of 10 MB",
        tensors(lambda content: content.update({"n" * 10_000_000: content.pop(max(content))})),
    )


def _overwrite(name: str, head: bytes) -> Damage:
    def damage(directory: Path) -> None:
        with (directory / name).open("r+b") as file:
            file.write(head)

    return damage


class _Execute:
    """A pickle that runs a command when it is loaded as Python loads pickles."""

    def __reduce__(self) -> Any:
        return os.system, ("touch executed",)


class _Storage:
    """Stands for a storage in a hand-made data.pkl."""

    def __init__(self, count: int) -> None:
        self.count = count


class _Oversized:
    """A tensor that says to be larger than its storage."""

    def __init__(self, shape: tuple[int, ...], stride: tuple[int, ...]) -> None:
        self.shape, self.stride = shape, stride

    def __reduce__(self) -> Any:
        import torch

        arguments = (_Storage(4), 0, self.shape, self.stride, False, {})
        return torch._utils._rebuild_tensor_v2, arguments


class _Pickler(pickle.Pickler):
    def persistent_id(self, value: object) -> Any:
        import torch

        return ("storage", torch.FloatStorage, "0", "cpu", value.count) if isinstance(value, _Storage) else None


def _archive(
    content: object, compression: int = zipfile.ZIP_STORED, data: bytes | None = None
) -> Callable[[Path], None]:
    """A file as torch.save writes it, with `content` in its data.pkl."""

    def write(path: Path) -> None:
        import io

        buffer = io.BytesIO()
        _Pickler(buffer, protocol=2).dump(content)
        with zipfile.ZipFile(path, "w", compression) as archive:
            archive.writestr("archive/data.pkl", buffer.getvalue() if data is None else data)
            archive.writestr("archive/data/0", b"\0" * 16)
            archive.writestr("archive/version", b"3\n")

    return write


def _pickles(name: str) -> Iterator[Case]:
    def saved(change: Callable[[dict[Any, Any]], object]) -> Damage:
        def damage(directory: Path) -> None:
            import torch

            content = torch.load(directory / name, weights_only=True)
            result = change(content)
            torch.save(content if result is None else result, directory / name)

        return damage

    def written(write: Callable[[Path], None]) -> Damage:
        return lambda directory: write(directory / name)

    def cast(kind: str) -> Damage:
        def change(content: dict[Any, Any]) -> None:
            import torch

            for key in content:
                content[key] = content[key].to(getattr(torch, kind))

        return saved(change)

    def fill(content: dict[Any, Any]) -> None:
        content[next(iter(content))].fill_(float("nan"))

    yield f"{name}: a bare pickle that executes", _writer(name, pickle.dumps(_Execute()))
    yield f"{name}: an archive that executes", written(_archive({"x": _Execute()}))
    yield f"{name}: a bomb", written(_archive({}, zipfile.ZIP_DEFLATED, b"\0" * 500_000_000))
    yield f"{name}: a memo of four billions", written(_archive({}, data=b"\x80\x02}r\xff\xff\xff\xff."))
    yield f"{name}: a text of an exabyte", written(_archive({}, data=b"\x80\x04\x8d" + struct.pack("<Q", 2**60)))
    yield f"{name}: a deep pickle", written(_archive({}, data=b"\x80\x02" + b"(" * 10**6))
    yield f"{name}: no pickle", written(_archive({}, data=b"nonsense"))
    yield f"{name}: larger than its storage", written(_archive({"x": _Oversized((10**5, 10**5), (10**5, 1))}))
    yield f"{name}: negative shape", written(_archive({"x": _Oversized((-1,), (1,))}))
    yield f"{name}: a list", saved(lambda content: list(content.values()))
    yield f"{name}: a tensor", saved(lambda content: next(iter(content.values())))
    yield f"{name}: nested", saved(lambda content: {"state_dict": dict(content)})
    for key in (1, None, ("a", 2), 2.5, b"x", True):
        yield (
            f"{name}: the key {key!r}",
            saved(lambda content, k=key: content.update({k: content.pop(next(iter(content)))})),
        )
    yield (
        f"{name}: a name of 10 MB",
        saved(lambda content: content.update({"n" * 10**7: content.pop(next(iter(content)))})),
    )
    for value in (3, "text", None, [1]):
        yield f"{name}: the value {value!r}", saved(lambda content, v=value: content.update({next(iter(content)): v}))
    yield f"{name}: sparse", saved(lambda content: content.update({max(content): content[max(content)].to_sparse()}))
    yield f"{name}: NaN inside", saved(fill)
    for kind in ("int64", "uint8", "bool", "complex64", "int16"):
        yield f"{name}: all {kind}", cast(kind)
    yield f"{name}: truncated", lambda d: os.truncate(d / name, (d / name).stat().st_size - 10)


def _openvla() -> Iterator[Case]:
    config, processor, index = "config.json", "preprocessor_config.json", "model.safetensors.index.json"
    text = "text_config"
    for key, value in (
        ("num_hidden_layers", 4),
        ("num_hidden_layers", 500),
        ("hidden_size", 32),
        ("vocab_size", 32000),
        ("num_attention_heads", 3),
        ("num_key_value_heads", 1),
        ("intermediate_size", 31),
        ("max_position_embeddings", 300_000_000),
        ("max_position_embeddings", 100),
        ("rms_norm_eps", -1.0),
        ("rope_theta", 0),
        ("rope_scaling", {"n" * 10**6: 1}),
        ("model_type", "m" * 10**6),
    ):
        name = f"config.json: {text}.{key} = {str(value)[:40]}"
        yield name, _edited(config, lambda d, k=key, v=value: d[text].update({k: v}))
    for key, value in (
        ("pad_to_multiple_of", 63),
        ("pad_to_multiple_of", 128),
        ("model_type", "x" * 10**7),
        ("vision_backbone_id", "x" * 10**6),
        ("vision_backbone_id", "siglip-vit-so400m"),
        ("image_resize_strategy", "letterbox"),
        ("image_sizes", [384, 384]),
        ("tiny_vision_overrides", {"embed_dim": 32, "depth": 3, "num_heads": 0}),
        ("tiny_vision_overrides", {"embed_dim": 32, "depth": 10**9, "num_heads": 2}),
        ("tiny_vision_overrides", None),
    ):
        yield f"config.json: {key} = {str(value)[:50]}", _edited(config, lambda d, k=key, v=value: d.update({k: v}))
    tower = {"mean": [0.5] * 3, "std": [0.5] * 3}
    for key, value in (
        ("tvf_normalize_params", [tower] * 3),
        ("tvf_normalize_params", [tower]),
        ("tvf_normalize_params", [{"mean": [0.5] * 2, "std": [0.5] * 3}] * 2),
        ("tvf_normalize_params", [{"mean": [0.5] * 3, "std": [0.5, 0, 0.5]}] * 2),
        ("tvf_normalize_params", [{"mean": [0.5] * 3, "std": [0.5, -0.5, 0.5]}] * 2),
        ("tvf_do_letterbox", True),
        ("image_resize_strategy", "letterbox"),
        ("input_sizes", [[3, 384, 384]] * 2),
        ("interpolations", ["bilinear"] * 2),
    ):
        yield f"{processor}: {key} = {value}", _edited(processor, lambda d, k=key, v=value: d.update({k: v}))
    for shard in (
        "x" * 5000 + ".safetensors",
        "x" * 300,
        "a\0b.safetensors",
        "../model.safetensors",
        ".",
        "",
        "config.json",
    ):
        change = {"language_model.lm_head.weight": shard}
        yield f"{index}: the file {shard[:30]!r}", _edited(index, lambda d, c=change: d["weight_map"].update(c))
    yield (
        f"{index}: a name of 7 MB",
        _edited(index, lambda d: d["weight_map"].update({"n" * 7_000_000: "m.safetensors"})),
    )
    yield (
        f"{index}: other shard",
        _edited(
            index,
            lambda d: d["weight_map"].update({"language_model.lm_head.weight": "model-00001-of-00002.safetensors"}),
        ),
    )


def _ranges(name: str, place: Callable[[Any], Any]) -> Iterator[Case]:
    """Damage to min, max, q01, q99 and mask of one vector."""

    def swap(document: Any) -> None:
        block = place(document)
        block["q01"], block["q99"] = block["q99"], block["q01"]

    yield f"{name}: q01 and q99 swapped", _edited(name, swap)
    yield f"{name}: q99 beyond max", _edited(name, lambda d: place(d)["q99"].__setitem__(0, 5.0))
    yield f"{name}: too few", _edited(name, lambda d: place(d).update(q01=[0.0]))
    yield f"{name}: a million values", _edited(name, lambda d: place(d).update(q01=[0.0] * 10**6))
    yield f"{name}: mask too short", _edited(name, lambda d: place(d).update(mask=[True]))
    yield f"{name}: no q01", _edited(name, lambda d: place(d).pop("q01"))


def _openvla_only() -> Iterator[Case]:
    yield from _openvla()
    yield from _ranges("config.json", lambda d: d["norm_stats"]["tiny"]["action"])
    long = _edited("config.json", lambda d: d.update(norm_stats={"n" * 10**6: d["norm_stats"]["tiny"]}))
    yield "config.json: a data set's name of 1 MB", long
    yield "config.json: no statistics", _edited("config.json", lambda d: d.update(norm_stats={}))


def _oft() -> Iterator[Case]:
    yield from _openvla()
    yield from _ranges("dataset_statistics.json", lambda d: d["tiny"]["action"])
    yield from _ranges("dataset_statistics.json", lambda d: d["tiny"]["proprio"])
    yield "two heads", lambda d: shutil.copy(d / HEADS["oft"][0], d / "action_head--2_checkpoint.pt")


def _pi0_blocks() -> Iterator[Case]:
    for key in (
        "num_hidden_layers",
        "num_attention_heads",
        "head_dim",
        "hidden_size",
        "num_key_value_heads",
        "vocab_size",
    ):
        for value in (3, 256, 2 * 10**9):
            where = ("vlm_config", "text_config", key)
            yield (
                f"config.json: {'.'.join(where)} = {value}",
                _edited("config.json", lambda d, w=where, v=value: _place(d, w, v)),
            )
    for key, value in (
        ("vlm_config", None),
        ("dit_config", {}),
        ("type", "x" * 10**7),
        ("min_period", 5.0),
        ("max_period", 0),
    ):
        yield (
            f"config.json: {key} = {str(value)[:40]}",
            _edited("config.json", lambda d, k=key, v=value: d.update({k: v})),
        )
    yield "roboneuron.json: a pipe", lambda d: ((d / "roboneuron.json").unlink(), os.mkfifo(d / "roboneuron.json"))[1]
    index = {"weight_map": {"a": "x" * 5000}}
    yield "index: a long name", _writer("model.safetensors.index.json", json.dumps(index).encode())
    index = {"weight_map": {"a": "../" * 20 + "etc/passwd"}}
    yield "index: another folder", _writer("model.safetensors.index.json", json.dumps(index).encode())
    yield "index: nothing", _writer("model.safetensors.index.json", b'{"weight_map": {}}')


def _lerobot() -> Iterator[Case]:
    yield from _pi0_blocks()
    images = {f"observation.images.{i}": {"type": "VISUAL", "shape": [3, 224, 224]} for i in range(1000)}
    action = {"action": {"type": "ACTION", "shape": [9]}}
    for key, value in (
        ("input_features", images),
        ("input_features", {}),
        ("output_features", action),
        ("empty_cameras", 10**9),
        ("image_resolution", [10**9, 10**9]),
        ("normalization_mapping", {"STATE": "x" * 10**6}),
    ):
        yield (
            f"config.json: {key} = {str(value)[:40]}",
            _edited("config.json", lambda d, k=key, v=value: d.update({k: v})),
        )
    for stage in ("pre", "post"):
        name = f"policy_{stage}processor.json"
        for state_file in ("x" * 5000, "../x", "a\0b", "..", "", None, 5):
            yield (
                f"{name}: state_file = {str(state_file)[:20]!r}",
                _edited(name, lambda d, s=state_file: d["steps"][0].update(state_file=s)),
            )
        yield (
            f"{name}: an unknown step of 1 MB",
            _edited(name, lambda d: d["steps"].append({"registry_name": "x" * 10**6, "config": {}})),
        )
        yield f"{name}: no steps", _edited(name, lambda d: d.update(steps=[]))
    for name in WEIGHT_FILES["pi0-lerobot"][1:]:
        for value in (0.0, -1.0, 1e30):
            yield f"{name}: std {value}", _moments(name, ".std", value)
        yield f"{name}: mean 1e30", _moments(name, ".mean", 1e30)


def _moments(name: str, ending: str, value: float) -> Damage:
    def damage(directory: Path) -> None:
        from safetensors.torch import load_file, save_file

        content = load_file(directory / name)
        for key in content:
            if key.endswith(ending):
                content[key][1] = value
        save_file(content, directory / name)

    return damage


def _openpi() -> Iterator[Case]:
    yield from _pi0_blocks()
    name = "assets/tiny/norm_stats.json"
    for part in ("state", "actions"):
        for value in (0.0, -1.0, 1e30, None):
            yield (
                f"{name}: {part}.std[1] = {value}",
                _edited(name, lambda d, p=part, v=value: d["norm_stats"][p]["std"].__setitem__(1, v)),
            )
        for values in ([], [1.0] * 10**6, [1.0] * 5, None, "x"):
            yield (
                f"{name}: {part}.std = {str(values)[:20]}",
                _edited(name, lambda d, p=part, v=values: d["norm_stats"][p].update(std=v)),
            )


_SPECIAL = {"openvla": _openvla_only, "oft": _oft, "pi0-lerobot": _lerobot, "pi0-openpi": _openpi}


def _memory(word: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(word):
            return int(line.split()[1]) * 1024
    raise LookupError(word)


def _expire(*_: object) -> None:
    raise TimeoutError(f"took more than {SECONDS} s")


def _run(layout: str, directory: Path, expected: list[float]) -> dict[str, object]:
    from roboneuron.errors import RoboNeuronError

    Path("/proc/self/clear_refs").write_text("5")  # starts the peak of resident memory anew
    before, started = _memory("VmRSS"), time.monotonic()
    signal.alarm(SECONDS)
    try:
        same = act(layout, directory) == expected
        outcome, text = ("same action" if same else "other action"), ""
    except RoboNeuronError as error:
        outcome, text = type(error).__name__, str(error)
    except BaseException as error:
        outcome, text = f"raw {type(error).__name__}", str(error)
    finally:
        signal.alarm(0)
    grown = _memory("VmHWM") - before
    return {
        "outcome": outcome,
        "text": text[:3000],
        "length": len(text),
        "seconds": time.monotonic() - started,
        "grown_bytes": grown,
    }


def main(layout: str, scratch: Path, stride: int) -> None:
    """See the module."""
    import torch

    torch.set_num_threads(1)
    os.chdir(scratch)
    original = scratch / "original"
    make(layout, original)
    expected = act(layout, original)
    signal.signal(signal.SIGALRM, _expire)
    limit = _memory("VmSize") + GROWTH_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for name, damage in itertools.islice(cases(layout, original), 0, None, stride):
        directory = scratch / "damaged"
        shutil.copytree(original, directory)
        damage(directory)
        result = _run(layout, directory, expected) | {"case": name, "executed": (scratch / "executed").exists()}
        print(json.dumps(result), flush=True)
        shutil.rmtree(directory)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]).resolve(), int(sys.argv[3]) if len(sys.argv) > 3 else 1)
