"""look and locate: what is seen is told with its mark and uncertainty, what cannot be seen is named
with the call that helps, and a pixel becomes a place or a reason.
"""

from __future__ import annotations

import io
import itertools
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from painted_cell import PaintedCell
from PIL import Image

from rn_testing.fakes.painted_table import overhead_camera, painted, side_camera
from rn_testing.waiting import wait_until
from roboneuron import (
    CalibratedImage,
    CameraView,
    InvalidInputError,
    LocatedObject,
    NotReadyError,
    RefusedError,
)
from roboneuron.sight import marks
from roboneuron.sight.cell_view import CellViews
from roboneuron.sight.marks import (
    find_object,
    label_boxes,
    look_pictures,
    name_of,
    nearest_like,
)
from roboneuron.sight.pointing import place_at

CUBES = {"red": (0.5, 0.1, 0.3), "green": (0.42, -0.1, -0.2), "blue": (0.6, 0.0, 0.6)}


def look(cell: PaintedCell, **arguments: Any) -> Any:
    return cell.call(cell.sight()[1]["look"], **arguments)


def seen(cell: PaintedCell) -> dict[str, Any]:
    answer: dict[str, Any] = look(cell).result.model_dump()
    return answer


WARM, COLD, GREEN = (0.6, 0.45, 0.3), (0.3, 0.4, 0.7), (0.4, 0.8, 0.4)


@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), (0.4, 0.4, 0.4), WARM, COLD, GREEN])
def test_objects_are_found_in_coloured_light_which_is_told(
    light: tuple[float, float, float],
) -> None:
    answer = seen(PaintedCell(cubes=CUBES, light=light))
    by_name = {one["name"]: one for one in answer["objects"]}
    assert by_name.keys() == {f"{name} cube" for name in CUBES}
    for name, (x_m, y_m, _) in CUBES.items():
        one = by_name[f"{name} cube"]
        off_m = np.linalg.norm(np.array(one["position_m"]) - [x_m, y_m, 0.022])
        assert off_m <= one["uncertainty_m"] + 1e-4
    is_coloured = max(light) != min(light)
    assert set(answer["problems"]) == ({"above", "side"} if is_coloured else set())


def test_objects_are_told_with_place_yaw_size_and_uncertainty() -> None:
    answer = seen(PaintedCell(cubes=CUBES))
    assert [one["mark"] for one in answer["objects"]] == [1, 2, 3]
    by_name = {one["name"]: one for one in answer["objects"]}
    assert by_name.keys() == {"red cube", "green cube", "blue cube"}
    for name, (x_m, y_m, yaw_rad) in CUBES.items():
        one = by_name[f"{name} cube"]
        off_m = np.linalg.norm(np.array(one["position_m"]) - [x_m, y_m, 0.022])
        assert off_m <= one["uncertainty_m"] + 1e-4
        assert one["symmetry_deg"] == 90.0
        turn = (one["yaw_deg"] - np.degrees(yaw_rad) + 45) % 90 - 45
        assert abs(turn) < 6
        assert set(one["cameras"]) == {"above", "side"}
        assert one["age_s"] < 5
    assert answer["problems"] == {}


def test_pictures_carry_marks_where_the_objects_are() -> None:
    answer = look(PaintedCell(cubes=CUBES))
    for told, file in zip(answer.result.pictures, answer.pictures, strict=True):
        picture = Image.open(io.BytesIO(file.data))
        assert picture.size == (told.width_px, told.height_px)
        assert told.marks_px.keys() == {"1", "2", "3"}
    bare = look(PaintedCell(cubes=CUBES), pictures=False)
    assert bare.pictures == ()
    assert [one.position_m for one in bare.result.objects] == [
        one.position_m for one in answer.result.objects
    ]


@pytest.mark.parametrize(
    "places",
    [
        [(0, 0), (447, 0), (0, 447), (447, 447)],
        [(200, 200), (230, 204), (200, 225), (215, 190)],
        [(440, 3), (430, 10)],
    ],
)
def test_labels_stay_in_the_picture_and_cover_no_other_ring_or_label(
    places: list[tuple[int, int]],
) -> None:
    size = (448, 448)
    boxes = label_boxes(places, [60, *[80] * len(places)], size)
    rings = [(x - 6, y - 6, x + 6, y + 6) for x, y in places]
    assert len(boxes) == len(places) + 1
    for number, box in enumerate(boxes):
        assert min(box) >= 0
        assert box[2] <= size[0]
        assert box[3] <= size[1]
        for other in [*boxes[:number], *(ring for ring in rings if number)]:
            apart = box[0] >= other[2] or other[0] >= box[2]
            assert apart or box[1] >= other[3] or other[1] >= box[3]


def test_labels_say_what_is_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    cell = PaintedCell(cubes=CUBES)
    feature, tools = cell.sight()
    cell.call(tools["look"])
    kept = feature.last_look("agent")
    assert kept is not None
    written: list[set[str]] = []
    monkeypatch.setattr(
        marks, "marked", lambda frame, labels, told: written.append({*labels.values(), told})
    )
    look_pictures(replace(kept, hidden=frozenset(kept.objects[:1])), caption="after")
    first, *others = [f"{n} {name_of(one)}" for n, one in enumerate(kept.objects, 1)]
    assert written[0] == {f"{first} (as last seen)", *others, "above after"}


def test_a_wide_picture_is_made_640_wide_and_its_pixels_mean_the_same_places() -> None:
    cell = PaintedCell(cubes=CUBES)
    feature, tools = cell.sight()
    cell.call(tools["look"])
    kept = feature.last_look("agent")
    assert kept is not None
    wide = [
        replace(
            image,
            frame=replace(
                image.frame,
                image=np.repeat(np.repeat(image.frame.image, 5, axis=0), 5, axis=1),
                calibration=replace(
                    image.frame.calibration,
                    intrinsics=np.diag([5.0, 5.0, 1.0]) @ image.frame.calibration.intrinsics,
                ),
            ),
        )
        for image in kept.view.images
        if image.frame.calibration is not None
    ]
    frames = tuple(image.frame for image in wide)
    feature._looks["agent"] = replace(
        kept, view=replace(kept.view, images=tuple(wide), frames=frames)
    )
    small = cell.call(tools["locate"], camera="above", pixel=[320.0, 320.0])
    assert small.position_m[:2] == pytest.approx([0.5, 0.0], abs=0.002)


@pytest.mark.parametrize(
    ("change", "camera", "words"),
    [
        ({"ages_s": {"above": 0.0}, "perception": "stopped"}, "side", "start_perception"),
        ({"ages_s": {"above": 0.0, "side": 30.0}}, "side", " s old"),
        ({"mounts": {"side": None}}, "side", "not calibrated"),
        ({"mounts": {"side": "tcp"}, "tcps": {}, "control": "stopped"}, "side", "start_control"),
        ({"mounts": {"side": "tcp"}, "tcps": {}}, "side", "is late"),
        ({"ages_s": {}, "perception": "stopped"}, "above", "start_perception"),
    ],
)
def test_a_camera_that_tells_no_places_is_named_and_the_rest_works(
    change: dict[str, Any], camera: str, words: str
) -> None:
    answer = seen(PaintedCell(cubes=CUBES, **change))
    assert words in answer["problems"][camera]
    works = {"above", "side"} - answer["problems"].keys()
    assert all(set(one["cameras"]) == works for one in answer["objects"])
    assert bool(answer["objects"]) == bool(works)
    assert all(any("height" in note for note in one["notes"]) for one in answer["objects"])


def test_a_camera_on_a_hand_sees_from_where_that_hand_is() -> None:
    arms = {"left": (0.0, 0.0, 0.0), "right": (0.2, 0.0, 0.0), "": (0.0, 0.0, 0.0)}
    cell = PaintedCell(
        cubes={"red": (0.5, 0.1, 0.3)},
        arms=("left", "right"),
        tcps=arms,
        mounts={"above": "right/tcp", "side": None},
    )
    answer = seen(cell)
    assert {hand["arm"] for hand in answer["hands"]} == {"left", "right"}
    (found,) = answer["objects"]
    # the right hand is turned by half a turn about x, and with it the camera
    assert found["position_m"][:2] == pytest.approx([0.7, -0.1], abs=0.01)


@pytest.mark.parametrize(
    ("opening", "commanded", "has_gripper", "holding"),
    [(1.0, 1.0, True, False), (0.5, 0.0, True, True), (1.0, 1.0, False, None)],
)
def test_the_hand_says_what_it_holds(
    opening: float, commanded: float, has_gripper: bool, holding: bool | None
) -> None:
    cell = PaintedCell(
        cubes={"red": (0.5, 0.1, 0.3), "blue": (0.6, 0.0, 0.6)},
        tcps={"": (0.5, 0.1, 0.03)},
        opening=opening,
        commanded=commanded,
        has_gripper=has_gripper,
    )
    (hand,) = seen(cell)["hands"]
    assert hand["holding"] is holding
    assert hand["holds"] == ("red cube" if holding else "")


def test_subscriptions_stay_for_the_next_look_and_end_when_nobody_looks() -> None:
    cell = PaintedCell(cubes=CUBES)
    views = CellViews(kept_s=0.3)
    views.take(cell.host, None, table_m=0.0)
    first = list(cell.takers)
    views.take(cell.host, None, table_m=0.0)
    assert cell.takers == first
    assert first
    views.renew()
    views.take(cell.host, None, table_m=0.0)
    assert len(cell.takers) == len(first)
    assert cell.takers != first, "a module was changed: what it sent may not hold any more"
    wait_until(lambda: not cell.takers, 10.0, "the subscriptions end")


def test_a_picture_from_before_the_look_is_not_shown() -> None:
    cell = PaintedCell(cubes=CUBES)
    views, profile = CellViews(), cell.profile()
    assert len(views.take(cell.host, profile, table_m=0.0).images) == 2
    with cell.lock:
        cell.ages_s = {"above": 0.0}
    view = views.take(cell.host, profile, table_m=0.0, wait_s=0.3)
    assert [image.frame.camera for image in view.images] == ["above"]
    assert view.problems.keys() == {"side"}
    views.close()
    assert not cell.takers


def test_a_first_picture_that_is_late_is_waited_for() -> None:
    cell, views = PaintedCell(cubes=CUBES, ages_s={}), CellViews()
    late = threading.Timer(0.3, cell.ages_s.update, [{"above": 0.0}])
    late.start()
    assert views.take(cell.host, cell.profile(), table_m=0.0, wait_s=0.05, blind_s=30.0).frames
    views.close()


def locate(cell: PaintedCell, **arguments: Any) -> Any:
    _, tools = cell.sight()
    cell.call(tools["look"])
    return cell.call(tools["locate"], **arguments)


def test_a_pixel_on_an_object_is_its_place_and_one_beside_it_the_table() -> None:
    cell = PaintedCell(cubes=CUBES)
    view = CameraView.of(overhead_camera(), np.eye(4))
    top = (2 * view.project(np.array([0.5, 0.1, 0.044]))).tolist()  # small pictures are enlarged
    on = locate(cell, camera="above", pixel=top)
    assert (on.surface, on.name) == ("object", "red cube")
    assert np.linalg.norm(np.array(on.position_m) - [0.5, 0.1, 0.044]) <= on.uncertainty_m
    bare = np.array([0.45, 0.05, 0.0])
    beside = locate(cell, camera="above", pixel=(2 * view.project(bare)).tolist())
    assert (beside.surface, beside.mark) == ("table", None)
    assert np.linalg.norm(np.array(beside.position_m) - bare) <= beside.uncertainty_m
    marked = locate(cell, mark=on.mark)
    assert (marked.name, marked.surface) == ("red cube", "object")


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"camera": "above", "pixel": [500, 3]}, InvalidInputError),
        ({"camera": "above", "pixel": [-1, 3]}, InvalidInputError),
        ({"camera": "none\u202e", "pixel": [5, 3]}, InvalidInputError),
        ({"mark": 9}, InvalidInputError),
        ({"camera": "above"}, InvalidInputError),
        ({"mark": 1, "pixel": [1, 1]}, InvalidInputError),
        ({"camera": "side", "pixel": [5, 3]}, NotReadyError),
    ],
)
def test_what_cannot_be_located_is_refused(arguments: dict[str, Any], error: type) -> None:
    cell = PaintedCell(cubes=CUBES, mounts={"side": None})
    with pytest.raises(error) as refusal:
        locate(cell, **arguments)
    assert "\u202e" not in str(refusal.value)


def low_camera(pitch_rad: float, height_m: float = 0.3) -> CalibratedImage:
    """A picture by a camera that looks along +x, downwards by an angle."""
    frame = replace(painted({})[0].frame, depth_m=None)
    ahead = np.array([np.cos(pitch_rad), 0.0, -np.sin(pitch_rad)])
    right = np.array([0.0, -1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = [0.0, 0.0, height_m]
    return CalibratedImage(frame=frame, T_base_camera=pose)


@pytest.mark.parametrize(("row", "rule"), [(5.0, "above_horizon"), (113.0, "too_far")])
def test_a_line_of_sight_that_meets_no_near_surface_is_refused(row: float, rule: str) -> None:
    with pytest.raises(RefusedError) as refusal:
        place_at(low_camera(0.0), np.array([112.0, row]), ())
    assert refusal.value.rule == rule


def test_depth_tells_places_that_are_on_no_table() -> None:
    low = low_camera(0.0)
    depth_m = np.full((224, 224), 0.5, dtype=np.float32)
    image = replace(low, frame=replace(low.frame, depth_m=depth_m))
    place = place_at(image, np.array([112.0, 112.0]), ())
    assert place.surface == "depth"
    assert place.position_m == pytest.approx([0.5, 0.0, 0.3], abs=1e-6)


def test_places_on_the_table_are_within_what_is_told_when_pointing_is_a_pixel_off() -> None:
    random = np.random.default_rng(4)
    frame = replace(painted({})[0].frame, depth_m=None)
    for calibration in (overhead_camera(), side_camera()):
        image = CalibratedImage(frame=frame, T_base_camera=calibration.T_mount_camera)
        within = []
        for _ in range(200):
            truth = np.array([random.uniform(0.4, 0.6), random.uniform(-0.1, 0.1), 0.0])
            off = random.normal(0.0, 1.5 / 2.448, 2)  # 95 % within the told 1.5 px
            place = place_at(image, image.view.project(truth) + off, ())
            within.append(np.linalg.norm(place.position_m - truth) <= place.uncertainty_m)
        assert np.mean(within) >= 0.90, "95 %, less three deviations of 200 places"


def one(name: str, x_m: float) -> LocatedObject:
    colour, label = name.split(" ")
    return LocatedObject(
        label=label,
        colour=colour,
        position_m=np.array([x_m, 0.0, 0.02]),
        size_m=np.full(3, 0.04),
        uncertainty_m=0.002,
        cameras=("above",),
        seen_at_ns=1,
    )


OBJECTS = [one("red cube", 0.3), one("red cube", 0.5), one("blue cup", 0.4)]


@pytest.mark.parametrize(("wanted", "x_m"), [(2, 0.5), ("blue", 0.4), ("CUP", 0.4)])
def test_objects_are_found_by_mark_and_by_unambiguous_words(wanted: str | int, x_m: float) -> None:
    assert find_object(OBJECTS, wanted).position_m[0] == x_m


@pytest.mark.parametrize("wanted", ["red", "red cube", "green", "", 0, 4, "\x1b[2J"])
def test_what_is_missing_or_ambiguous_is_refused_with_what_is_seen(wanted: str | int) -> None:
    with pytest.raises(InvalidInputError) as refusal:
        find_object(OBJECTS, wanted)
    assert '3 "blue cup"' in str(refusal.value)
    assert "\x1b" not in str(refusal.value)


def test_an_object_is_found_again_where_it_was() -> None:
    found = nearest_like(OBJECTS, one("red cube", 0.49), 0.05)
    assert found is OBJECTS[1]
    assert nearest_like(OBJECTS, one("red cube", 0.8), 0.05) is None


def test_words_of_a_locator_are_made_printable() -> None:
    hostile = replace(OBJECTS[0], label="cube\u202e\x1b[2J" + "x" * 500)
    assert "\u202e" not in name_of(hostile)
    assert "\x1b" not in name_of(hostile)
    assert len(name_of(hostile)) <= 40


def test_the_first_answer_of_a_blind_cell_takes_less_than_a_second() -> None:
    cell = PaintedCell(ages_s={}, perception="stopped")
    assert look(cell).result.took_s < 1.0


def test_every_combination_of_cameras_is_answered() -> None:
    for names in itertools.chain.from_iterable(
        itertools.combinations(("above", "side"), count) for count in (1, 2)
    ):
        cell = PaintedCell(cubes=CUBES, ages_s=dict.fromkeys(names, 0.0))
        answer = seen(cell)
        assert [told["camera"] for told in answer["pictures"]] == list(names)
        assert len(answer["objects"]) == 3
