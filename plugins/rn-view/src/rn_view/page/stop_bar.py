"""The bar above the page with the emergency stop: plain HTML and requests, so that it needs no seat
and no WebGL.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path

from roboneuron import PluginError

STOP_PATH = "/emergency_stop"
"""GET with the header below latches the emergency stop; `?robot=NAME` that of one robot."""
STATE_PATH = "/emergency_stop/state"
HEADER = "X-RoboNeuron"
"""Pages of other origins cannot send it without being allowed to, and no link or image can."""
HEADER_VALUE = "stop"
KEY = "F9"
TITLE = "RoboNeuron"
_HEAD, _BODY = "<title>Viser</title>", '<div id="root"></div>'
"""What is replaced in viser's page."""

DARK_COOKIE, WIDTH_COOKIE = "roboneuron_dark", "roboneuron_width"
_TELL_DARK = f"""document.cookie = "{DARK_COOKIE}=" +
  Number(matchMedia("(prefers-color-scheme: dark)").matches) + "; path=/; SameSite=Strict";
document.cookie = "{WIDTH_COOKIE}=" + Math.round(innerWidth) + "; path=/; SameSite=Strict";"""
"""Before viser's program connects: it is the server that says whether its part is dark, and where
the panels are. The width of the scene is another, once a panel is beside it.
"""
_STYLE = """
:root { --rn-bar: 84px; }
:root { --rn-paper: #fff; --rn-ink: #212529; --rn-dim: #495057; --rn-edge: #adb5bd; --rn-line: #868e96; --rn-soft: #e9ecef; --rn-blue: #1864ab;
  --rn-on-blue: #fff; --rn-chosen: #d0ebff; --rn-good: #d3f9d8; --rn-warn: #fff3bf; --rn-bad: #ffe3e3; --rn-well: #f1f3f5; --rn-hair: #ced4da; --rn-red: #b01e1e; }
@media (prefers-color-scheme: dark) {
  :root { --rn-paper: #25262b; --rn-ink: #e9ecef; --rn-dim: #ced4da; --rn-edge: #5c5f66; --rn-line: #868e96; --rn-soft: #373a40; --rn-blue: #74c0fc;
    --rn-on-blue: #101113; --rn-chosen: #1c3d5a; --rn-good: #1e4620; --rn-warn: #5c4a00; --rn-bad: #5c1f1f; --rn-well: #2c2e33; --rn-hair: #5c5f66; --rn-red: #ff8787; }
  #rn-bar, #rn-lead, #rn-strip, #rn-records { color-scheme: dark; }
}
#root { position: fixed; top: var(--rn-bar); left: 0; right: 0; bottom: 0; transform: translateZ(0); }
#root, body { --mantine-color-blue-filled: #1864ab; --mantine-color-blue-filled-hover: #0b4a86;
  --mantine-color-blue-outline: #1864ab; --mantine-color-blue-text: #1864ab; --mantine-color-dimmed: #555c63; }
@media (prefers-color-scheme: dark) {
  #root, body { --mantine-color-blue-outline: #74c0fc; --mantine-color-blue-text: #74c0fc; --mantine-color-dimmed: #ced4da; }
  #root .mantine-Tabs-tab[data-active] { color: #74c0fc; }
}
#rn-bar { position: fixed; top: 0; left: 0; right: 0; height: 84px; z-index: 2147483647; display: flex;
  gap: 12px; align-items: stretch; padding: 8px; box-sizing: border-box; background: var(--rn-paper);
  border-bottom: 1px solid var(--rn-edge); font: 15px/1.3 system-ui, sans-serif; color: var(--rn-ink); }
#rn-bar button { border: 0; border-radius: 6px; background: #b01e1e; color: #fff; font: inherit; font-weight: 700;
  cursor: pointer; padding: 0 18px; min-width: 64px; min-height: 60px; }
#rn-bar button:hover { background: #8f1515; }
#rn-bar button:focus-visible { outline: 4px solid var(--rn-blue); outline-offset: 2px; }
#rn-bar button:active { background: #6b0f0f; }
#rn-stop { flex: 1 1 60%; font-size: 24px !important; letter-spacing: 0.04em; }
#rn-stop kbd { font: inherit; font-size: 14px; font-weight: 400; letter-spacing: 0; margin-left: 10px; padding: 2px 7px;
  border: 1px solid #fff; border-radius: 4px; }
#rn-state { flex: 1 1 30%; min-width: 0; align-self: center; max-height: 100%; overflow: auto; }
#rn-bar.latched { background: #b01e1e; color: #fff; }
#rn-bar.latched button { background: #fff; color: #8f1515; }
#rn-bar.latched kbd { border-color: #8f1515; }
#rn-bar.lost { background: #ffe066; color: #212529; }
@media (max-width: 600px) {
  #rn-bar { gap: 8px; padding: 6px; font-size: 13px; }
  #rn-stop { font-size: 19px !important; padding: 0 6px !important; flex-basis: 62%; }
  #rn-stop kbd { display: none; }
  .rn-one { padding: 0 6px !important; }
}
"""  # noqa: E501
_SCRIPT = """
(() => {
  const bar = document.getElementById("rn-bar"), state = document.getElementById("rn-state");
  const robots = CONFIG.robots, wait = ms => new Promise(done => setTimeout(done, ms));
  let pressing = "", failures = 0;
  const ask = async (path, headers) => {
    const answer = await fetch(path, {headers, cache: "no-store", signal: AbortSignal.timeout(8000)});
    const told = await answer.json();
    if (!answer.ok) throw new Error(told.text || answer.statusText);
    return told;
  };
  const show = (word, text) => { bar.className = word; if (state.textContent !== text) state.textContent = text; };
  const press = async robot => {
    pressing = "Stopping " + (robot || (robots.length > 1 ? "all robots" : robots[0] || "the robot")) + " ...";
    show("", pressing);
    for (let tries = 0; tries < 40; tries++) {
      try {
        const told = await ask(CONFIG.stop + (robot ? "?robot=" + encodeURIComponent(robot) : ""),
          {[CONFIG.header]: CONFIG.value});
        pressing = "";
        show("latched", told.text);
        return;
      } catch (error) {
        show("lost", "NOT STOPPED FROM HERE: " + error.message + ". Use the robot's own stop. Trying again ...");
        await wait(300);
      }
    }
    pressing = "";
  };
  const look = async () => {
    try {
      const latched = (await ask(CONFIG.state, {})).latched;
      failures = 0;
      if (pressing) return;
      const names = Object.keys(latched), held = names.filter(name => latched[name]);
      const which = names.length > 1 ? " of " + held.join(", ") : "";
      if (!held.length) show("", CONFIG.ready);
      else show("latched", "STOPPED" + which + ". A person releases it with: roboneuron estop --reset");
    } catch (error) {
      if (++failures > 2 && !pressing)
        show("lost", "No connection to the server (" + error.message + "). Use the robot's own stop.");
    }
  };
  for (const button of bar.querySelectorAll("button"))
    button.addEventListener("click", () => press(button.dataset.robot));
  addEventListener("keydown", event => {
    if (event.key !== CONFIG.key || event.repeat) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    press("");
  }, true);
  const label = () => {
    for (const one of document.querySelectorAll(".mantine-Notification-closeButton:not([aria-label])"))
      one.setAttribute("aria-label", "Close this notice");
    for (const one of document.querySelectorAll("#root button.mantine-ActionIcon-root:not([aria-label])"))
      one.setAttribute("aria-label", "Settings of the view");
    for (const one of document.querySelectorAll("#root input:not([aria-label]), #root textarea:not([aria-label])")) {
      if (one.labels && one.labels.length) continue;
      const row = one.closest("[class*=Flex],[class*=Grid],[class*=Group]") || one.parentElement.parentElement;
      let place = row, text = "";
      for (let up = 0; place && up < 4 && !text; up++) {
        text = (place.querySelector("label") || place).innerText.trim().split("\\n")[0];
        place = place.parentElement;
      }
      one.setAttribute("aria-label", text || "Value");
    }
    if (document.title !== CONFIG.title) document.title = CONFIG.title;
  };
  new MutationObserver(label).observe(document.documentElement, {childList: true, subtree: true});
  label();
  (async () => { for (;;) { await look(); await wait(document.hidden ? 5000 : 1000); } })();
})();
"""  # noqa: E501


def base_page() -> str:
    """viser's page.

    Raises:
        PluginError: this version of viser has another page than this package expects.
    """
    import viser  # heavy

    page = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text(
        encoding="utf-8"
    )
    if page.count(_HEAD) != 1 or page.count(_BODY) != 1:
        raise PluginError(
            f"The page of viser {viser.__version__} is another than expected.",
            hint="Use viser 1.1.",
        )
    return page


def page_with_bar(base: str, robots: Sequence[str]) -> str:
    """The page of these robots, with the emergency stop.

    Args:
        base: result of `base_page`.
        robots: their names; with several, each has its own stop beside the common one.
    """
    title = f"{', '.join(robots)} - {TITLE}" if any(robots) else TITLE
    several = len(robots) > 1
    ones = "".join(
        f'<button type="button" class="rn-one" data-robot="{escape(name)}">Stop '
        f"{escape(name)}</button>"
        for name in robots
        if several
    )
    what = "EMERGENCY STOP, ALL" if several else "EMERGENCY STOP"
    bar = (
        '<div id="rn-bar" role="region" aria-label="Emergency stop">'
        f'<button id="rn-stop" type="button" data-robot="" aria-keyshortcuts="{KEY}" title="Key '
        f"{KEY}, anywhere on "
        f'this page">{what}<kbd>{KEY}</kbd></button>{ones}<div id="rn-state" '
        'role="status" aria-live="assertive"></div></div>'
    )
    told = {
        "robots": list(robots),
        "stop": STOP_PATH,
        "state": STATE_PATH,
        "header": HEADER,
        "value": HEADER_VALUE,
        "key": KEY,
        "title": title,
        "ready": f"Not pressed. {', '.join(robots)}".rstrip(". "),
    }
    script = _SCRIPT.replace("(() => {", f"(() => {{ const CONFIG = {_json(told)};", 1)
    head = f"<title>{escape(title)}</title><style>{_STYLE}</style><script>{_TELL_DARK}</script>"
    page = base.replace(_HEAD, head)
    return page.replace(_BODY, f"{bar}{_BODY}<script>{script}</script>")


def page_without_stop(base: str, title: str) -> str:
    """The page of a recording: without the emergency stop, as there is no robot."""
    return base.replace(_HEAD, f"<title>{escape(title)} - {TITLE}</title>")


def _json(value: object) -> str:
    """JSON that is safe within a script element."""
    return json.dumps(value).replace("<", "\\u003c")
