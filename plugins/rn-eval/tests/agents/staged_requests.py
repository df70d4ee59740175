"""Staged episodes of a person's requests: done right, or wrong in one way."""

from __future__ import annotations

import math

import numpy as np
from agent_stage import HOME_M, Stage, said

from rn_eval.agents.conduct import Conduct, ToolCall
from rn_eval.agents.tasks.base import started_at
from rn_eval.agents.tasks.scenes import cubes_of


def raised(scene, *, up_m=0.08, turn_deg=90.0):
    target = scene.text("target")
    acted = Stage(scene).lift(target)
    acted.yaws[target] += math.radians(turn_deg)
    return acted.by(dz=up_m, carry=target).stand().truth(), said()


def held_out(scene, off_m=0.0):
    target = scene.text("target")
    place = (0.5, scene.number("y_m") + off_m, 0.35)
    return Stage(scene).lift(target).go(place, carry=target).stand().truth(), said()


def stacked_then_picked(scene, *, stacks=True, share=0.9, y_m=0.0, lifts=True):
    """Stack at full speed, then pick up again by a share of the allowed speed."""
    target, other = scene.text("target"), cubes_of(scene)[scene.text("other")]
    acted = Stage(scene).lift(target)
    if stacks:
        height = other.edge_m + cubes_of(scene)[target].edge_m / 2
        acted.put(target, other.x_m, other.y_m, height)
    speed = scene.number("speed") / 100 * share
    if y_m:
        aside = (acted.tcp[0], y_m * (1 if scene.text("side") == "left" else -1), acted.tcp[2])
        acted.go(aside, seconds=math.dist(acted.tcp, aside) / speed)
    if lifts:
        place = acted.cubes[target].copy()
        acted.go(place, seconds=max(0.5, math.dist(acted.tcp, place) / speed))
        acted.finger = 0.02
        acted.by(dz=0.2, seconds=0.2 / speed, carry=target)
    return acted.stand().truth(), said()


def put_gently(scene, seconds=4.0):
    target = scene.text("target")
    acted = Stage(scene).lift(target)
    acted.put(target, scene.number("x_m"), scene.number("y_m"), seconds=seconds)
    return acted.truth(), said()


def put_turned(scene, off_deg=0.0):
    target = scene.text("target")
    acted = Stage(scene).lift(target)
    acted.yaws[target] = math.radians(scene.number("yaw") + 90.0 + off_deg)
    return acted.put(target, scene.number("x_m"), scene.number("y_m")).truth(), said()


def put_beside(scene, *, more_m=0.0, flip=1.0, holds=False):
    """Put parallel to the other cube, with the gap and some more, on its side or the other one."""
    target, other = scene.text("target"), scene.text("other")
    acted = Stage(scene).lift(target)
    left = 1.0 if scene.text("side") == "left" else -1.0
    yaw = math.remainder(acted.yaws[other], math.pi / 2)
    apart = scene.number("gap") / 100 + more_m + (acted.edges[target] + acted.edges[other]) / 2
    way = flip * left * apart * np.array([-math.sin(yaw), math.cos(yaw)])
    acted.yaws[target] = yaw
    x, y = acted.cubes[other][:2] + way
    if holds:
        acted.go((x, y, acted.edges[target] / 2), carry=target)
        return acted.stand().truth(), said()
    return acted.put(target, x, y).truth(), said()


def arranged(scene, places, *, lifts=True):
    """Put each cube at its place (x, y or x, y, z)."""
    acted = Stage(scene)
    for colour, place in places:
        acted.lift(colour)
        acted.put(colour, *place)
    return acted.truth(), said()


def lined_up(scene, *, more_m=0.0, aside_m=0.0):
    step = scene.number("apart") / 100 + more_m
    places = [(n, (0.4 + step * i, 0.3 + aside_m * i)) for i, n in enumerate(scene.colours)]
    return arranged(scene, places)


def swapped(scene, off_m=0.0, only_one=False):
    one, other = scene.text("one"), scene.text("other")
    x, y = started_at(scene, other)
    places = [(one, (x + off_m, y)), (other, started_at(scene, one))]
    return arranged(scene, places[: 1 if only_one else 2])


def towered(scene, order=("low", "middle", "top"), off_m=0.0):
    low, *others = (scene.text(name) for name in order)
    cubes, (x, y) = cubes_of(scene), started_at(scene, low)
    height, places = cubes[low].edge_m, []
    for colour in others:
        places.append((colour, (x + off_m, y, height + cubes[colour].edge_m / 2)))
        height += cubes[colour].edge_m
    return arranged(scene, places)


def sized(scene, upper="small", lower="large", off_m=0.0):
    cubes, (x, y) = cubes_of(scene), started_at(scene, scene.text(lower))
    upper, lower = cubes[scene.text(upper)], cubes[scene.text(lower)]
    return arranged(scene, [(upper.name, (x + off_m, y, lower.edge_m + upper.edge_m / 2))])


def cleared(scene, *, all_of_them=True, others=False):
    sign = 1.0 if scene.text("half") == "left" else -1.0
    there = [n for n in scene.colours if started_at(scene, n)[1] * sign > 0]
    left = [n for n in scene.colours if n not in there]
    moved = [*(there if all_of_them else there[1:]), *(left if others else ())]
    return arranged(scene, [(n, (0.3, -sign * (0.1 + 0.1 * i))) for i, n in enumerate(moved)])


def turned_in_place(scene, turn_deg=45.0, off_m=0.0):
    target = scene.text("target")
    acted = Stage(scene)
    (x, y), _ = started_at(scene, target), acted.lift(target)
    acted.yaws[target] += math.radians(turn_deg)
    return acted.put(target, x + off_m, y).truth(), said()


def put_and_back(scene, *, goes=True, returns=True):
    target = scene.text("target")
    there = (scene.number("x_m"), scene.number("y_m"))
    return arranged(
        scene, [(target, there)] * goes + [(target, started_at(scene, target))] * returns
    )


def pushed(scene, *, share=1.0, rise=0.0, other=False):
    target = scene.text("target")
    x, y = started_at(scene, target)
    dx, dy = scene.number("x_m") - x, scene.number("y_m") - y
    acted = Stage(scene).slide(target, share * dx, share * dy, rise)
    if other:
        acted.slide(next(n for n in scene.colours if n != target), 0.03, 0.0)
    return acted.truth(), said()


def saw_the_wrist(scene, *, answer_bytes=20_000, camera="wrist", moves=False):
    acted = Stage(scene)
    if moves:
        acted.by(dz=0.1)
    arguments = f'{{"camera": "{camera}"}}'
    call = ToolCall(
        at_s=1.0, tool="get_camera_image", arguments=arguments, answer_bytes=answer_bytes
    )
    return acted.truth(), Conduct(words="CLAIM: done", calls=(call,))


def told_ahead(scene, off_cm=0.0, moves=False):
    height = 48.7 - scene.number("low")
    acted = Stage(scene)
    if moves:
        acted.by(dz=-0.1)
    answer = "no" if height < 0 else f"{height + off_cm:.1f}"
    return acted.truth(), said(answer=answer if not off_cm or height >= 0 else "12")


def got_ready(scene, running=("robot", "perception", "control"), moves=False):
    acted = Stage(scene)
    if moves:
        acted.by(dz=0.1)
    return acted.truth(), Conduct(words="CLAIM: done", running=running)


def waved(scene, times=3, touches=False):
    acted = Stage(scene)
    for _ in range(times):
        acted.go(joint7=1.2).go(joint7=0.4)
    if touches:
        acted.slide(scene.colours[0], 0.03, 0.0)
    return acted.stand().truth(), said()


def over_it(scene, off_m=0.0, touches=False):
    target = scene.text("target")
    x, y = started_at(scene, target)
    acted = Stage(scene)
    acted.go((x, y, acted.edges[target] + scene.number("above") / 100 + off_m))
    if touches:
        acted.slide(target, 0.015, 0.0)
    return acted.stand().truth(), said()


def told_the_speed(scene, share=1.0, rises=True):
    acted = Stage(scene)
    if rises:
        acted.by(dz=scene.number("distance") / 100)
    truth = acted.stand().truth()
    return truth, said(answer=f"{share * 100 * truth.tcp_speed_m_s():.1f} cm/s")


def told_today(scene, *, swaps=False, moves=False):
    picked, failed = scene.text("picked").replace(" ", ", "), scene.text("failed")
    acted = Stage(scene)
    if moves:
        acted.by(dz=0.1)
    picked, failed = (failed, picked) if swaps else (picked, failed)
    return acted.truth(), said(answer=f"{picked}; failed: {failed}")


def held_and_told(scene, *, names=True, lifts=True):
    target = scene.text("target")
    acted = Stage(scene)
    if lifts:
        acted.lift(target)
    other = next(name for name in scene.colours if name != target)
    return acted.truth(), said(answer=target if names else other)


def left_safe(scene, *, lifts=True, seconds=4.0, falls=False):
    target = scene.text("target")
    acted = Stage(scene)
    if not lifts:
        return acted.truth(), said()
    acted.lift(target)
    x, y, _ = acted.tcp
    if falls:
        acted.finger = 0.04
        acted.cubes[target] = np.array([x, y, acted.edges[target] / 2])
        return acted.stand().truth(), said()
    return acted.put(target, x, y, seconds=seconds).go(HOME_M).stand().truth(), said()


def looked_at_table(scene, *, off_m=0.0, kind="simulated", names=None):
    cubes = cubes_of(scene).values()
    places = [f"{c.name} {c.x_m + off_m:.3f} {c.y_m:.3f}" for c in cubes]
    return Stage(scene).truth(), said(answer="; ".join([kind, *places[:names]]))
