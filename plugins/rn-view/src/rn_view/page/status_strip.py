"""The strip below the stop: alarms, rates at a glance, past tasks and maintenance; HTML of our own,
so that it is made for keyboards and screen readers, and survives a reload.
"""

from __future__ import annotations

import json
from html import escape

from rn_view.page.status_strip_script import SCRIPT
from rn_view.web.page_requests import KEY_HEADER, PATH

_KEY_ID = "rn-page-key"

_STYLE = """
html.rn-strip { --rn-bar: 128px; }
#rn-strip { position: fixed; top: 84px; left: 0; right: 0; height: 44px; z-index: 2147483646; display: none; gap: 8px; align-items: center;
  padding: 0 8px; box-sizing: border-box; background: var(--rn-paper); color: var(--rn-ink); border-bottom: 1px solid var(--rn-edge);
  font: 14px/1.35 system-ui, sans-serif; }
html.rn-strip #rn-strip { display: flex; }
#rn-strip button, #rn-records button { font: inherit; min-height: 36px; border: 1px solid var(--rn-line); border-radius: 6px; background: var(--rn-paper);
  color: var(--rn-ink); padding: 0 12px; cursor: pointer; white-space: nowrap; }
#rn-records button { min-height: 44px; }
#rn-strip button:focus-visible, #rn-records button:focus-visible, #rn-records input:focus-visible, #rn-records [tabindex]:focus-visible {
  outline: 3px solid var(--rn-blue); outline-offset: 2px; }
#rn-strip button[aria-expanded=true] { background: var(--rn-chosen); border-color: var(--rn-blue); }
#rn-alarms-open { overflow: hidden; text-overflow: ellipsis; min-width: 96px; max-width: 44%; text-align: left; }
#rn-strip #rn-alarms-open.warn, #rn-strip #rn-service-open.out { background: #ffe066; border-color: #7a5d00; color: #212529; font-weight: 600; }
#rn-strip #rn-alarms-open.bad { background: var(--rn-bad); border: 2px solid var(--rn-red); font-weight: 700; }
#rn-glance { flex: 1 1 auto; min-width: 0; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; font-variant-numeric: tabular-nums;
  color: var(--rn-dim); }
#rn-glance b { color: var(--rn-ink); font-weight: 600; }
#rn-glance .bad { color: var(--rn-red); font-weight: 700; }
#rn-glance.limit { background: var(--rn-warn); color: var(--rn-ink); border-radius: 6px; padding: 6px 10px; }
#rn-records { position: fixed; top: calc(var(--rn-bar) + 8px); left: 12px; width: min(620px, calc(100% - 24px)); max-height: calc(100dvh - var(--rn-bar) - 24px);
  overflow: auto; z-index: 2147483645; display: none; box-sizing: border-box; background: var(--rn-paper); color: var(--rn-ink); border: 1px solid var(--rn-edge);
  border-radius: 10px; padding: 12px 14px; box-shadow: 0 4px 18px #0003; font: 14px/1.4 system-ui, sans-serif; overflow-wrap: anywhere; }
#rn-records.open { display: block; }
#rn-records h2 { font-size: 16px; margin: 0; flex: 1 1 auto; }
#rn-records h3 { font-size: 14px; margin: 14px 0 4px; }
#rn-records .row { display: flex; gap: 8px; align-items: center; flex-wrap: wrap; }
#rn-records ul { list-style: none; margin: 10px 0 0; padding: 0; display: grid; gap: 8px; }
#rn-records li { border: 1px solid var(--rn-edge); border-left: 6px solid var(--rn-line); border-radius: 6px; padding: 8px 10px; }
#rn-records li.bad { border-left-color: #b01e1e; background: var(--rn-bad); }
#rn-records li.warn { border-left-color: #b08600; background: var(--rn-warn); }
#rn-records li.good { border-left-color: #237032; }
#rn-records .dim { color: var(--rn-dim); font-size: 13px; }
#rn-records li.bad .dim, #rn-records li.warn .dim { color: var(--rn-ink); }
#rn-records table { border-collapse: collapse; width: 100%; font-size: 13px; }
#rn-records th, #rn-records td { text-align: left; padding: 3px 8px 3px 0; border-bottom: 1px solid var(--rn-hair); vertical-align: top; }
#rn-records .shots { display: flex; gap: 8px; margin-top: 6px; }
#rn-records figure { margin: 0; flex: 0 1 200px; }
#rn-records figure img { width: 100%; display: block; border-radius: 4px; background: var(--rn-well); }
#rn-records label { display: block; margin-top: 10px; }
#rn-records input { font: inherit; width: 100%; box-sizing: border-box; min-height: 44px; padding: 0 12px; margin-top: 4px; border: 1px solid var(--rn-line);
  border-radius: 6px; background: var(--rn-paper); color: inherit; }
#rn-records button.main { background: var(--rn-blue); border-color: var(--rn-blue); color: var(--rn-on-blue); font-weight: 600; }
#rn-records-say { padding: 8px 10px; border-radius: 6px; background: var(--rn-bad); margin-top: 8px; }
#rn-records-say:empty { display: none; }
.rn-short { display: none; }
.rn-unseen { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); white-space: nowrap; }
@media (max-width: 820px) {
  html.rn-strip { --rn-bar: 154px; }
  #rn-strip { height: 70px; flex-wrap: wrap; row-gap: 0; padding-top: 4px; }
  #rn-alarms-open { flex: 1 1 0; max-width: none; }
  #rn-strip button { padding: 0 10px; }
  #rn-glance { order: 9; flex: 1 1 100%; font-size: 13px; height: 24px; line-height: 22px; }
  #rn-glance.limit { padding: 0 8px; }
}
@media (max-width: 576px) {
  #rn-records { left: 0; right: 0; width: 100%; top: var(--rn-bar); max-height: calc(100dvh - var(--rn-bar)); border-radius: 0; }
  .rn-long { display: none; }
  .rn-short { display: inline; }
}
"""  # noqa: E501

_BODY = """
<div id="rn-strip" role="region" aria-label="Alarms and state">
 <button id="rn-alarms-open" type="button" aria-expanded="false" aria-controls="rn-records">No alarms</button>
 <div id="rn-glance"></div>
 <button id="rn-tasks-open" type="button" aria-expanded="false" aria-controls="rn-records" aria-label="Past tasks" hidden><span class="rn-long">Past tasks</span><span class="rn-short">Tasks</span></button>
 <button id="rn-service-open" type="button" aria-expanded="false" aria-controls="rn-records" hidden>Maintenance</button>
</div>
<div id="rn-alert" class="rn-unseen" role="alert"></div>
<section id="rn-records" aria-labelledby="rn-records-title">
 <div class="row"><h2 id="rn-records-title" tabindex="-1"></h2><button id="rn-records-close" type="button" aria-label="Close this panel">&times;</button></div>
 <div id="rn-records-say" role="status"></div>
 <div id="rn-records-body"></div>
</section>
"""  # noqa: E501


def key_html(key: str) -> str:
    """What tells the page the key of its requests."""
    return f'<div id="{_KEY_ID}" data-key="{escape(key, quote=True)}"></div>'


def with_records(page: str) -> str:
    """A page with the strip and its panel, which show once it is known who looks."""
    config = json.dumps({"id": _KEY_ID, "path": PATH, "header": KEY_HEADER})
    script = SCRIPT.replace("(() => {", f"(() => {{ const CONFIG = {config};", 1)
    page = page.replace("</head>", f"<style>{_STYLE}</style></head>", 1)
    # first in the order of Tab after the stop
    page = page.replace('<div id="root"></div>', f'{_BODY}<div id="root"></div>', 1)
    return page.replace("</body>", f"<script>{script}</script></body>", 1)
