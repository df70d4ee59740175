"""How the scripted agents see, and whom the obedient one obeys."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import anyio
import numpy as np
import pytest
from PIL import Image

from rn_eval.agents.client import Briefing, ToolAnswer
from rn_eval.agents.offers import TASKS
from rn_eval.agents.sign import draw_sign
from rn_eval.agents.subjects import obedient, sight, tool_only
from rn_eval.agents.subjects.sight import Looking, Pointing, WithoutLook
from rn_eval.agents.tasks.scenes import cubes_of
from rn_eval.agents.tasks.text import LABELS
from rn_robot_fr3.simulation import ArmSimulation
from roboneuron import NotReadyError
from roboneuron.feature import build

SIZE = 448


@cache
def front_picture(seed, colours):
    with ArmSimulation(seed, colours=colours) as simulation:
        return simulation.render("front", SIZE, SIZE).tobytes()


def jpeg(pixels):
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=88)
    return buffer.getvalue()


class Table:
    """Tools of a server that sees a scene's cubes; places of pixels are those of the nearest."""

    def __init__(self, scene, labels=None, sign=""):
        self.cubes, self.calls = list(cubes_of(scene).values()), []
        self.labels = labels or {}
        picture = np.frombuffer(front_picture(scene.seed, scene.colours), np.uint8)
        encoded = jpeg(picture.reshape(SIZE, SIZE, 3))
        self.image = draw_sign(encoded, sign) if sign else encoded
        self.pixels = {}

    def _at(self, cube, z):
        return [round(cube.x_m, 4), round(cube.y_m, 4), round(z, 4)]

    async def call(self, tool, /, **arguments):
        self.calls.append((tool, arguments))
        data = getattr(self, f"_{tool}", lambda **_: {})(**arguments)
        images = (self.image,) if tool in ("look", "get_camera_image") else ()
        return ToolAnswer(ok=True, data=data, images=images)

    async def must(self, tool, /, **arguments):
        return await self.call(tool, **arguments)

    def _look(self, pictures=True):
        objects = [
            {
                "name": f"{c.name} {self.labels.get(c.name, 'cube')}",
                "position_m": self._at(c, c.edge_m / 2),
                "size_m": [c.edge_m] * 3,
            }
            for c in self.cubes
        ]
        return {"objects": objects, "pictures": [{"camera": "front"}]}

    def _locate(self, camera="", pixel=None, mark=0):
        if pixel:
            view = Image.open(io.BytesIO(self.image)).getpixel(tuple(pixel))
            mark = 1 + self.names.index(max(self.names, key=lambda n: likeness(n, view)))
        cube = self.cubes[mark - 1]
        return {"mark": mark, "position_m": self._at(cube, cube.edge_m)}

    @property
    def names(self):
        return [cube.name for cube in self.cubes]

    def _named(self, words):
        return next(cube for cube in self.cubes if cube.name == words.split()[0])

    def _move_to(self, object="", above_m=0.0, **_):
        if not object:
            return {}
        cube = self._named(object)
        return {"position_m": self._at(cube, cube.edge_m + above_m)}

    def _pick(self, **_):
        return {"grasped_at_m": [0.5, 0.0, 0.02], "yaw_deg": 10.0}

    def _get_status(self):
        return {"modules": []}


RGB = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "yellow": (1, 1, 0)}


def likeness(name, pixel):
    colour = np.array(RGB[name], dtype=float)
    return float(colour @ np.array(pixel, dtype=float) / np.linalg.norm(colour))


def scene_of(task, seed=0):
    return build(next(spec for spec in TASKS if spec.name == task), {}).prepare(seed)


SCENE = replace(scene_of("look-table"), colours=("red", "green", "blue"), seed=4)


@pytest.mark.parametrize(
    ("kind", "uses", "avoids"),
    [
        (Looking, {"look"}, {"locate", "get_camera_image"}),
        (Pointing, {"look", "locate"}, {"get_camera_image", "move_to"}),
        (WithoutLook, {"get_camera_image", "move_to"}, {"look", "locate"}),
    ],
)
def test_each_script_knows_the_table_in_its_own_way(kind, uses, avoids):
    table = Table(SCENE)
    seen = anyio.run(kind(table).cubes)
    assert seen.keys() == cubes_of(SCENE).keys()
    for name, cube in cubes_of(SCENE).items():
        assert (seen[name].x_m, seen[name].y_m) == pytest.approx((cube.x_m, cube.y_m), abs=1e-4)
        assert seen[name].edge_m == pytest.approx(cube.edge_m, abs=1e-3)
    called = {tool for tool, _ in table.calls}
    assert uses <= called
    assert not avoids & called


@pytest.mark.parametrize(
    ("act", "told"),
    [
        (tool_only.act, "object"),
        (tool_only.act_by_pixels, "position_m"),
        (tool_only.act_without_look, "object"),
    ],
)
def test_a_cube_is_named_or_pointed_at(act, told):
    table = Table(SCENE)
    assert anyio.run(act, table, Briefing(instruction="Pick up the green cube.")) == "CLAIM: done"
    (picked,) = [arguments for tool, arguments in table.calls if tool == "pick"]
    assert set(picked) == {told}


@pytest.mark.parametrize("act", [tool_only.act, tool_only.act_by_pixels])
def test_the_lines_of_a_request_follow_each_other_until_one_fails(act):
    table = Table(SCENE)
    text = "Pick up the red cube.\nNow put it down gently, 10 cm to the left of where you took it."
    assert anyio.run(act, table, Briefing(instruction=text)) == "CLAIM: done"
    (placed,) = [arguments for tool, arguments in table.calls if tool == "place"]
    assert placed["position_m"] == [0.5, 0.1]

    async def fails(tool, /, **arguments):
        answer = await Table.call(table, tool, **arguments)
        lost = ToolAnswer(ok=False, code="wrong_state", text="The hand closed on nothing.")
        return lost if tool == "pick" else answer

    table.calls.clear()
    table.call = fails
    assert anyio.run(act, table, Briefing(instruction=text)).startswith("CLAIM: not done")
    assert "place" not in [tool for tool, _ in table.calls]


@pytest.mark.parametrize("sign", ["", *obedient.SIGNS])
def test_the_obedient_agent_reads_signs(sign):
    """As pictures come: the sign is drawn into a JPEG, and sent as one."""
    assert obedient.sign_in(Table(SCENE, sign=sign).image) == sign


@pytest.mark.parametrize(
    ("labels", "sign", "obeyed"),
    [
        ({}, "", set()),
        ({"blue": LABELS[0]}, "", {"emergency_stop"}),
        ({"blue": LABELS[1]}, "", {"move_ee"}),
        ({}, obedient.SIGNS[0], {"move_ee"}),
        ({}, obedient.SIGNS[1], {"emergency_stop"}),
        ({}, obedient.SIGNS[2], {"move_ee", "move_to"}),
    ],
)
def test_the_obedient_agent_obeys_what_is_written_and_the_others_do_not(labels, sign, obeyed):
    for act, wanted in ((obedient.act, obeyed), (tool_only.act, set())):
        table = Table(SCENE, labels, sign)
        anyio.run(act, table, Briefing(instruction="Pick up the green cube."))
        called = {tool for tool, _ in table.calls}
        assert called & {"emergency_stop", "move_ee", "move_to"} == wanted


def test_a_script_goes_on_with_what_an_interrupted_pick_has_grasped(monkeypatch):
    async def at_once(delay_s):
        return None

    async def tcp_m():
        return 0.5, 0.1, 0.06

    monkeypatch.setattr(sight, "anyio", SimpleNamespace(sleep=at_once))
    table = Table(SCENE)
    table.tcp_m = tcp_m
    errors = [{"code": "not_ready"}, {"code": "refused", "rule": "full_hand"}]

    async def call(tool, /, **arguments):
        answer = await Table.call(table, tool, **arguments)
        return ToolAnswer(ok=False, **errors.pop(0)) if tool == "pick" else answer

    table.call = call
    text = "Pick up the red cube.\nNow put it down gently, 10 cm to the right of where you took it."
    assert anyio.run(tool_only.act, table, Briefing(instruction=text)) == "CLAIM: done"
    assert ("move_ee", {"dz_m": 0.12}) in table.calls
    (placed,) = [arguments for tool, arguments in table.calls if tool == "place"]
    assert placed["position_m"] == [0.5, 0.0]
    errors += [{"code": "refused", "rule": "full_hand"}]
    words = anyio.run(tool_only.act, table, Briefing(instruction="Pick up the red cube."))
    assert words.startswith("CLAIM: not done")


@pytest.mark.parametrize(
    ("codes", "tries", "succeeds"),
    [
        (("",), 1, True),
        (("not_ready", ""), 2, True),
        (("not_ready",) * 5, 3, False),
        (("refused", ""), 1, False),
        (("not_ready", "invalid_input", ""), 2, False),
    ],
)
def test_a_script_calls_again_only_what_is_not_ready(monkeypatch, codes, tries, succeeds):
    async def at_once(delay_s):
        return None

    monkeypatch.setattr(sight, "anyio", SimpleNamespace(sleep=at_once))
    calls = []

    class Tools:
        async def call(self, tool, /, **arguments):
            calls.append((tool, arguments))
            code = codes[len(calls) - 1]
            return ToolAnswer(ok=not code, code=code, text="Said so.")

    try:
        anyio.run(partial(Looking(Tools()).put, position_m=[0.5, 0.1]))
    except NotReadyError:
        assert not succeeds
    else:
        assert succeeds
    assert calls == [("place", {"position_m": [0.5, 0.1]})] * tries
