"""A frozen camera is found by its content while the arm moves, and by its stamps."""

from __future__ import annotations

from dataclasses import replace

from monitors import frame, observation, pose

from rn_standard.tasks.pictures import FrozenPictures


def working() -> FrozenPictures:
    """A camera that has sent two pictures."""
    watch = FrozenPictures()
    watch.look(observation(100, 0.1), -0.9)
    assert watch.look(observation(101, 0.2), -0.8) == ""
    return watch


def test_one_picture_shows_no_working_camera() -> None:
    watch = FrozenPictures()
    assert "no second picture" in watch.look(observation(7, 1.0), 0.0)
    assert "no second picture" in watch.look(observation(7, 1.0), 0.5)
    assert watch.look(observation(7, 1.1), 0.6) == ""


def test_equal_pictures_of_an_arm_at_rest_are_fine() -> None:
    watch = working()
    for step in range(50):
        assert watch.look(observation(7, 1.0 + 0.2 * step), 0.2 * step) == ""


def test_an_equal_picture_of_a_moved_arm_is_frozen_until_another_comes() -> None:
    watch = working()
    assert watch.look(observation(7, 1.0, 0.20), 0.0) == ""
    assert "not changed although the arm has moved" in watch.look(observation(7, 1.2, 0.23), 0.2)
    assert watch.look(observation(7, 1.4, 0.20), 0.4), "also once the arm is back"
    assert watch.look(observation(8, 1.6, 0.20), 0.6) == ""


def test_an_equal_picture_of_a_moved_gripper_is_frozen() -> None:
    watch = working()
    assert watch.look(observation(7, 1.0), 0.0) == ""
    closed = replace(observation(7, 1.2), gripper_open=0.3)
    assert "has not changed" in watch.look(closed, 0.2)


def test_a_stamp_that_stays_is_too_old() -> None:
    watch = working()
    assert watch.look(observation(7, 1.0), 0.0) == ""
    assert watch.look(observation(7, 1.0), 0.9) == ""
    assert "is 1.5 s old" in watch.look(observation(7, 1.0), 1.5)
    assert "is 1.6 s old" in watch.look(observation(8, 1.0), 1.6), "new content, old stamp"


def test_a_picture_much_older_than_the_pose_is_too_old() -> None:
    late = replace(observation(), frames={"primary": frame(3, 10.0)}, ee_pose=pose(0.2, 13.0))
    assert "is 3.0 s old" in FrozenPictures().look(late, 0.0)
