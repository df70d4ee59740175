"""What a person sees and presses, in a real browser."""

from __future__ import annotations

from urllib.parse import urlparse

import pytest
from view_fakes import joints, picture
from view_page import PIXEL, wait_until

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default:Queued a:UserWarning")]
"""viser says so when a page is closed while it is being filled."""
VIEWER, OPERATOR = ("a-token-for-looking-1", "viewer"), ("a-token-for-acting-22", "operator")


def test_one_page_shows_everything_and_stops_the_robot(serve, look, source, operator):
    """One page has state, pictures, buttons and the stop, within seconds; nothing is loaded from
    other hosts.
    """
    viewer = serve()
    assert not source.subscribed
    hosts: set[str | None] = set()
    page = look_and_note(look, viewer.url, hosts)
    page.get_by_text("lift the <cup>").wait_for()
    # as text: nothing that somebody said becomes HTML
    page.get_by_text("failing: <b>lost</b>").wait_for()

    wait_until(lambda: "camera/front/image" in source.subscribed)
    source.send("joint_states", joints(turn=0.5, lift=0.1))

    def shows_the_picture():
        source.send("camera/front/image", picture(200))
        return abs(page.evaluate(PIXEL) - 200) <= 3  # JPEG

    wait_until(shows_the_picture)

    page.get_by_role("textbox").first.fill("wave")
    page.get_by_text("Give the instruction").click()
    assert operator.called.wait(60)
    who, tool, arguments = operator.calls[0]
    assert (tool, arguments) == ("set_instruction", {"instruction": "wave"})
    assert who.startswith("local HTTP client view")

    page.get_by_text("EMERGENCY STOP").first.click()
    assert source.stopped.wait(60)
    page.get_by_text("EMERGENCY STOP LATCHED").wait_for()
    assert hosts - {None} == {"127.0.0.1"}  # a picture that is in the page already has no host

    assert who in operator.open  # a page that is open renews the lease
    page.context.close()
    wait_until(lambda: not source.subscribed)  # nobody looks any more
    # the page that was reloaded has left before
    wait_until(lambda: who in operator.left and not operator.open)


def look_and_note(look, url, hosts):
    page = look(url)
    page.on("request", lambda request: hosts.add(urlparse(request.url).hostname))
    page.reload()
    page.get_by_text("EMERGENCY STOP").first.wait_for()
    return page


def test_without_a_token_there_is_nothing_but_the_stop(serve, look, source):
    viewer = serve(VIEWER, OPERATOR)
    page = look(viewer.url)
    page.get_by_role("textbox").first.wait_for()
    assert page.get_by_text("Instruction:").count() == 0
    assert not source.subscribed
    page.get_by_text("EMERGENCY STOP").first.click()
    assert source.stopped.wait(60)

    page.get_by_role("textbox").first.fill(VIEWER[0])
    page.get_by_text("Show the robot", exact=True).click()
    page.get_by_text("Instruction:").wait_for()
    assert page.get_by_text("Give the instruction").count() == 0  # a viewer has no buttons
    assert source.subscribed
