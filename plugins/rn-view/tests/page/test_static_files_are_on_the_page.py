"""Styles, HTML and scripts are files of the package, and all of them are on the page."""

from __future__ import annotations

from importlib import resources

from rn_view.page.robot_area import with_robot_area
from rn_view.page.status_strip import with_status_strip
from rn_view.page.stop_bar import base_page, page_with_bar
from rn_view.static import read_static, script_element
from rn_view.teleoperation.stick_panel import with_stick_panel


def test_every_file_is_on_the_page() -> None:
    bare = page_with_bar(base_page(), ["left"], {"": "release it"})
    page = with_status_strip(with_stick_panel(with_robot_area(bare, is_live=True)))
    names = [path.name for path in resources.files("rn_view.static").iterdir() if path.is_file()]
    shown = sorted(name for name in names if name.endswith((".css", ".html", ".js")))
    assert [name for name in shown if name.endswith(".js")] == [
        "label_form.js",
        "robot_area.js",
        "status_strip.js",
        "stick_panel.js",
        "stop_bar.js",
    ]
    for name in shown:
        first, *_, last = read_static(name).strip().splitlines()
        assert first in page, name
        assert last in page, name


def test_a_name_cannot_end_a_script() -> None:
    assert script_element("label_form.js", {"name": "</script>"}).count("</script>") == 1
