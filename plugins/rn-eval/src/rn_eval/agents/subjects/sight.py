"""How a scripted agent learns where objects lie, from tools alone."""

from __future__ import annotations

import io
from dataclasses import dataclass

import anyio
import numpy as np
from PIL import Image

from rn_eval.agents.client import ToolAnswer, ToolClient
from rn_eval.agents.subjects.reading import named_colours
from rn_eval.agents.tasks.steps import seen_colours, start_everything
from roboneuron import NotReadyError
from roboneuron.sight import segmentation

_OVER_M = 0.1
_LIFTED_M = 0.18
_TRIES, _AGAIN_S = 3, 1.0


@dataclass(frozen=True, slots=True)
class Seen:
    """A cube: its centre in the base frame, and its edge [m]."""

    x_m: float
    y_m: float
    edge_m: float


class Looking:
    """Names objects as `look` lists them.

    Attributes:
        tools: of the server.
        at_first: x and y of cubes when they were first needed.
        held: colour of the cube that was taken last; "" for none.
        taken_m, taken_deg: x and y at which it was grasped, and the yaw of the hand.
    """

    def __init__(self, tools: ToolClient) -> None:
        self.tools = tools
        self.at_first: dict[str, tuple[float, float]] = {}
        self.held = ""
        self.taken_m = (0.0, 0.0)
        self.taken_deg = 0.0
        self._is_started = False

    async def start(self) -> None:
        """Start everything, once. Raises NotReadyError."""
        if self._is_started:
            return
        answer = await start_everything(self.tools)
        if not answer.ok:
            raise NotReadyError(f"start_all: {answer.text}")
        self._is_started = True

    async def insist(self, tool: str, **arguments: object) -> ToolAnswer:
        """Call a tool again while its parts are not ready: a camera's picture is late, or control
        was. For calls that name where to end, so that a second one is no second shift. Raises
        NotReadyError.
        """
        for _ in range(_TRIES):
            answer = await self.tools.call(tool, **arguments)
            if answer.code != "not_ready":
                break
            await anyio.sleep(_AGAIN_S)
        if not answer.ok:
            raise NotReadyError(f"{tool}: {answer.text}")
        return answer

    async def put(self, **where: object) -> None:
        """Put down what is held: at a position, on or beside a cube. Raises NotReadyError."""
        await self.insist("place", **where)
        self.held = ""

    async def cubes(self) -> dict[str, Seen]:
        """All cubes on the table by colour. Raises NotReadyError."""
        found = await self._find()
        places = {colour: (one.x_m, one.y_m) for colour, one in found.items()}
        self.at_first = {**places, **self.at_first}
        return found

    async def _find(self) -> dict[str, Seen]:
        await self.start()
        objects = (await self.insist("look", pictures=False)).data["objects"]
        assert isinstance(objects, list)
        found = {}
        for one in objects:
            (colour, *_), (x, y, _) = named_colours(str(one["name"])), one["position_m"]
            found[colour] = Seen(x, y, one["size_m"][2])
        return found

    async def words_for(self, colour: str) -> str:
        """How `place` is told about a cube."""
        return f"{colour} cube"

    async def pointer(self, colour: str, tool: str) -> dict[str, object]:
        """Arguments that tell pick, push or move_to about a cube."""
        return {"object": f"{colour} cube"}

    async def go_over(self, colour: str, above_m: float) -> None:
        """Move the hand over a cube. Raises NotReadyError."""
        await self.start()
        await self.insist(
            "move_to", **await self.pointer(colour, "move_to"), above_m=round(above_m, 4)
        )

    async def take(self, colour: str) -> None:
        """Pick up a cube. Raises NotReadyError."""
        await self.start()
        where = await self.pointer(colour, "pick")
        told = await self.tools.call("pick", **where)
        was_interrupted = told.code == "not_ready"
        if was_interrupted:
            await anyio.sleep(_AGAIN_S)
            told = await self.tools.call("pick", **where)
        if was_interrupted and told.rule == "full_hand":  # after it had closed the hand
            x, y, z = await self.tools.tcp_m()
            await self.tools.must("move_ee", dz_m=round(max(0.0, _LIFTED_M - z), 4))
        elif told.ok:
            place = told.data["grasped_at_m"]
            assert isinstance(place, list)
            x, y, _ = place
            self.taken_deg = told.number("yaw_deg")
        else:
            raise NotReadyError(f"pick: {told.text}")
        self.held, self.taken_m = colour, (x, y)
        self.at_first.setdefault(colour, self.taken_m)


class Pointing(Looking):
    """Points at pixels of the front camera's picture; the colours of pixels are seen by itself."""

    async def _find(self) -> dict[str, Seen]:
        found = {}
        for colour, pixel in (await self._pixels()).items():
            mark = (await self.insist("locate", camera="front", pixel=pixel)).data["mark"]
            place = (await self.insist("locate", mark=mark)).data["position_m"]
            assert isinstance(place, list)
            found[colour] = Seen(*place)
        return found

    async def _pixels(self) -> dict[str, list[int]]:
        """Middle of the region of each colour, in the front camera's picture of a new look."""
        await self.start()
        looked = await self.insist("look")
        pictures = looked.data["pictures"]
        assert isinstance(pictures, list)
        cameras = [str(picture["camera"]) for picture in pictures]
        if "front" not in cameras:
            raise NotReadyError(f"look has no picture of the front camera: {looked.data}")
        with Image.open(io.BytesIO(looked.images[cameras.index("front")])) as opened:
            picture = np.asarray(opened.convert("RGB"))
        found = {}
        for colour, mask in segmentation.colour_masks(picture):
            if blobs := segmentation.blobs_of(mask):
                found[colour] = [round(value) for value in blobs[0].pixels.mean(axis=0).tolist()]
        return found

    async def _located(self, colour: str) -> dict[str, object]:
        pixels = await self._pixels()
        if colour not in pixels:
            told = ", ".join(pixels)
            raise NotReadyError(f"No {colour} pixels are seen, only {told}.")
        return (await self.insist("locate", camera="front", pixel=pixels[colour])).data

    async def words_for(self, colour: str) -> str:
        """The mark at its pixel."""
        return f"mark {(await self._located(colour))['mark']}"

    async def pointer(self, colour: str, tool: str) -> dict[str, object]:
        """The place at its pixel; push takes a mark."""
        found = await self._located(colour)
        key = "mark" if tool == "push" else "position_m"
        return {key: found[key]}

    async def go_over(self, colour: str, above_m: float) -> None:
        """Move the hand over the middle of the cube's top. Raises NotReadyError."""
        mark = (await self._located(colour))["mark"]
        place = (await self.insist("locate", mark=mark)).data["position_m"]
        assert isinstance(place, list)
        x, y, top = place
        await self.insist("move_to", position_m=[x, y, round(top + above_m, 4)])


class WithoutLook(Looking):
    """Calls neither `look` nor `locate`: colours from a picture, places from simulated moves."""

    async def _find(self) -> dict[str, Seen]:
        found = {}
        await self.start()
        for colour in await seen_colours(self.tools):
            over = await self.insist(
                "move_to", object=f"{colour} cube", above_m=_OVER_M, simulate=True
            )
            place = over.data["position_m"]
            assert isinstance(place, list)
            x, y, z = place
            found[colour] = Seen(x, y, z - _OVER_M)
        return found


def by_edge(cubes: dict[str, Seen]) -> list[str]:
    """Colours, from the smallest cube to the largest."""
    return sorted(cubes, key=lambda colour: cubes[colour].edge_m)


async def leftmost_of(sight: Looking) -> str:
    """The colour of the cube furthest to the robot's left. Raises NotReadyError."""
    cubes = await sight.cubes()
    return max(cubes, key=lambda colour: cubes[colour].y_m)
