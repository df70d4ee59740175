"""The part of the page by which a person leads the arm: sticks, keys and gamepads; HTML of our own
beside viser's, so that 50 samples a second pass neither viser's messages nor its scene.
"""

from __future__ import annotations

import json
from html import escape

from rn_view.recordings import label_form

SOCKET_PATH = "/lead/socket"
"""A websocket; `?key=` of a page that may lead."""
PROTOCOL = "viser-v1"
"""Subprotocol of that websocket: the server of viser accepts none of another name."""
RATE_HZ = 50
FULL_M_S, FULL_RAD_S, FULL_SHARE = 0.25, 0.8, 0.25
"""Speed of a stick that is pushed to its end; of a joint as a share of its limit."""
_KEY_ID = "rn-lead-key"

_STYLE = """
#rn-lead { position: fixed; left: 322px; right: 392px; bottom: 12px; z-index: 1000; display: none; font: 14px/1.35 system-ui, sans-serif;
  color: var(--rn-ink); pointer-events: none; justify-content: center; }
#rn-lead.there { display: flex; }
#rn-lead > * { pointer-events: auto; }
#rn-lead button, #rn-lead select { font: inherit; min-height: 44px; border: 1px solid var(--rn-line); border-radius: 6px; background: var(--rn-paper); color: var(--rn-ink);
  padding: 0 12px; cursor: pointer; touch-action: manipulation; }
#rn-lead button:focus-visible, #rn-lead select:focus-visible, .rn-stick:focus-visible { outline: 3px solid var(--rn-blue); outline-offset: 2px; }
#rn-lead button.main { background: var(--rn-blue); border-color: var(--rn-blue); color: var(--rn-on-blue); font-weight: 600; }
#rn-lead button[aria-pressed=true] { background: var(--rn-chosen); border-color: var(--rn-blue); font-weight: 600; }
#rn-lead button:disabled, #rn-lead select:disabled { opacity: .55; cursor: default; }
#rn-lead-box { width: min(720px, 100%); background: var(--rn-paper); border: 1px solid var(--rn-edge); border-radius: 10px; padding: 12px; box-sizing: border-box;
  box-shadow: 0 4px 18px #0003; display: none; max-height: calc(100dvh - var(--rn-bar) - 24px); overflow: auto; }
#rn-lead.open #rn-lead-box { display: block; }
#rn-lead.open #rn-lead-open { display: none; }
#rn-lead-open { box-shadow: 0 2px 8px #0003; }
#rn-lead .row { display: flex; gap: 8px; flex-wrap: wrap; align-items: center; }
#rn-lead .row + .row, #rn-label-box textarea + .row { margin-top: 10px; }
#rn-lead .grow { flex: 1 1 auto; }
#rn-lead label { display: inline-flex; gap: 6px; align-items: center; }
#rn-lead input[type=range] { width: 110px; min-height: 44px; }
#rn-lead-state { flex: 1 1 100%; padding: 8px 10px; border-radius: 6px; background: var(--rn-soft); min-height: 20px; overflow-wrap: anywhere; }
#rn-lead-state.moves { background: var(--rn-good); }
#rn-lead-state.limit { background: var(--rn-warn); }
#rn-lead-state.bad { background: var(--rn-bad); }
#rn-lead .middle { display: flex; gap: 16px; align-items: center; margin: 10px 0; }
#rn-lead .sticks { display: flex; gap: 16px; flex: 1 1 auto; justify-content: space-around; align-items: flex-start; }
#rn-lead .stickbox { text-align: center; font-size: 13px; color: var(--rn-dim); }
.rn-stick { position: relative; width: 128px; height: 128px; border-radius: 50%; background: var(--rn-well); border: 2px solid var(--rn-line); touch-action: none;
  margin: 0 auto 4px; cursor: grab; }
.rn-stick::before, .rn-stick::after { content: ""; position: absolute; background: var(--rn-hair); }
.rn-stick::before { left: 50%; top: 12px; bottom: 12px; width: 1px; }
.rn-stick::after { top: 50%; left: 12px; right: 12px; height: 1px; }
.rn-stick i { position: absolute; left: 50%; top: 50%; width: 48px; height: 48px; margin: -24px; border-radius: 50%; background: var(--rn-blue); z-index: 1; }
.rn-stick.held { border-color: var(--rn-blue); cursor: grabbing; }
#rn-lead.idle .rn-stick i { background: var(--rn-line); }
#rn-lead .hint { font-size: 13px; color: var(--rn-dim); }
#rn-lead kbd { border: 1px solid var(--rn-edge); border-radius: 3px; padding: 0 4px; font: inherit; font-size: 12px; }
#rn-lead-numbers { font-variant-numeric: tabular-nums; white-space: nowrap; }
@media (max-width: 1250px) { #rn-lead .middle { flex-direction: column; align-items: stretch; } }
@media (max-width: 1100px) { #rn-lead { left: 12px; } }
@media (max-width: 576px) {
  #rn-lead { left: 0; right: 0; bottom: 0; }
  #rn-lead.there:not(.open, .labels) { top: calc(var(--rn-bar) + 8px); bottom: auto; left: auto; right: 8px; }
  #rn-lead .controls { display: flex; flex-wrap: wrap; gap: 8px 14px; }
  #rn-lead .controls .row { margin: 0; flex-wrap: nowrap; }
  #rn-lead-box, #rn-label-box { border-radius: 12px 12px 0 0; padding: 10px; width: 100%; }
  #rn-lead .hint { display: none; }
  .rn-stick { width: 116px; height: 116px; }
}
"""  # noqa: E501

_BODY = """
<section id="rn-lead" class="idle" aria-label="By hand">
 <button id="rn-lead-open" type="button" class="main">Lead by hand</button>LABEL_OPEN
 <div id="rn-lead-box">
  <div class="row">
   <button id="rn-lead-go" type="button" class="main">Lead the arm</button>
   <button id="rn-lead-blend" type="button">Correct the policy</button>
   <button id="rn-lead-operate" type="button" hidden>Become the operator</button>
   <button id="rn-lead-back" type="button" class="main" hidden>Hand back</button>
   <span class="grow"></span>
   <span id="rn-lead-numbers" aria-label="Delay from this page to the joint command and back"></span>
   <button id="rn-lead-close" type="button" aria-label="Close this panel">&times;</button>
   <div id="rn-lead-state" role="status">Nobody leads from this page.</div>
  </div>
  <div class="middle">
  <div class="sticks">
   <div class="stickbox"><div class="rn-stick" id="rn-stick-a" tabindex="-1" role="img" aria-label="Stick: forwards, sideways"><i></i></div><span id="rn-name-a"></span></div>
   <div class="stickbox"><div class="rn-stick" id="rn-stick-b" tabindex="-1" role="img" aria-label="Stick: up, turn"><i></i></div><span id="rn-name-b"></span></div>
  </div>
  <div class="controls">
  <div class="row">
   <button id="rn-lead-turn" type="button" aria-pressed="false">Turn</button>
   <button id="rn-lead-tool" type="button" aria-pressed="false">Tool frame</button>
  </div>
  <div class="row">
   <span>Gripper</span>
   <button id="rn-grip-open" type="button" aria-label="Open the gripper">Open</button>
   <button id="rn-grip-close" type="button" aria-label="Close the gripper">Close</button>
  </div>
  <div class="row">
   <label>Speed <input id="rn-lead-scale" type="range" min="10" max="100" step="10" value="50"><output id="rn-lead-percent">50 %</output></label>
  </div>
  <div class="row">
   <label>Joint <select id="rn-lead-joint"></select></label>
   <button id="rn-joint-less" type="button" aria-label="Joint backwards, while held">&minus;</button>
   <button id="rn-joint-more" type="button" aria-label="Joint forwards, while held">+</button>
  </div>
  </div>
  </div>
  <div class="row"><span class="hint">Hold a stick, or <kbd>Space</kbd> with <kbd>W</kbd><kbd>A</kbd><kbd>S</kbd><kbd>D</kbd> <kbd>R</kbd><kbd>F</kbd>, arrows and <kbd>Q</kbd><kbd>E</kbd> to turn, <kbd>O</kbd><kbd>C</kbd> gripper; a gamepad: hold a shoulder button.</span>
  </div>
 </div>LABEL_BODY
</section>
"""  # noqa: E501

_SCRIPT = """
(() => {
  const el = id => document.getElementById(id), lead = el("rn-lead"), state = el("rn-lead-state");
  let socket = null, key = "", leads = false, asking = false, number = 0, gripper = null, joints = {}, lastEcho = 0, delays = [];
  const sent = new Map(), keys = new Set(), sticks = {a: [0, 0, false], b: [0, 0, false]};
  let jog = 0, mayOperate = false;
  const say = (text, word = "") => { if (state.textContent !== text) state.textContent = text; state.className = word; };
  const show = () => {
    lead.classList.toggle("idle", !leads);
    el("rn-lead-go").hidden = el("rn-lead-blend").hidden = leads;
    el("rn-lead-back").hidden = !leads;
    el("rn-lead-operate").hidden = leads || !mayOperate;
    el("rn-lead-go").disabled = el("rn-lead-blend").disabled = asking || !socket || socket.readyState !== 1;
    el("rn-lead-scale").disabled = leads;
    for (const id of ["rn-grip-open", "rn-grip-close", "rn-joint-less", "rn-joint-more"]) el(id).disabled = !leads;
    const turn = el("rn-lead-turn").getAttribute("aria-pressed") === "true";
    el("rn-name-a").textContent = turn ? "tilt" : "forwards, sideways";
    el("rn-name-b").textContent = "up, turn";
    if (!leads) el("rn-lead-numbers").textContent = "";
  };
  const send = value => { if (socket && socket.readyState === 1) socket.send(JSON.stringify(value)); };
  const connect = () => {
    const place = el(CONFIG.key), found = place ? place.dataset.key : "";
    lead.classList.toggle("there", !!found || leads);
    el("rn-label-open").hidden = !found || place.dataset.labels !== "1";
    el("rn-lead-open").hidden = !!found && place.dataset.joints === "{}";
    if (!found || (found === key && socket && socket.readyState < 2)) return;
    if (socket) socket.close();
    key = found;
    const limits = JSON.parse(place.dataset.joints);
    joints = limits;
    el("rn-lead-joint").replaceChildren(...Object.keys(limits).map(name => new Option(name, name)));
    const own = socket = new WebSocket(location.origin.replace("http", "ws") + CONFIG.path + "?key=" + encodeURIComponent(key), [CONFIG.protocol]);
    own.onopen = show;
    own.onmessage = event => { if (own === socket) hear(JSON.parse(event.data)); };
    own.onclose = () => {
      if (own !== socket) return;
      if (leads) say("The connection is lost: the arm brakes. Start again once the page is connected.", "bad");
      leads = asking = false; socket = null; show();
      dispatchEvent(new CustomEvent("rn-lost"));
    };
    show();
  };
  const hear = told => {
    dispatchEvent(new CustomEvent("rn-told", {detail: told}));
    if (told.led !== undefined) {
      asking = false; leads = told.led; gripper = null;
      if (leads) say("You lead. Hold a stick, Space, or a shoulder button of a gamepad.");
      else say(told.text || "Handed back.", told.text ? "bad" : "");
      mayOperate = /take_over/.test(told.text || "");
      show();
    } else if (told.operates) {
      mayOperate = false; say("You operate the robot now. Lead the arm when you are ready."); show();
    } else if (told.echo) {
      const [count, who, limits, note] = told.echo, at = sent.get(count);
      for (const old of sent.keys()) if (old <= count) sent.delete(old);
      if (at !== undefined) {
        delays.push(performance.now() - at);
        if (delays.length > 100) delays.shift();
        const sorted = [...delays].sort((x, y) => x - y);
        el("rn-lead-numbers").textContent = sorted[sorted.length >> 1].toFixed(0) + " ms, p99 " + sorted[Math.floor(sorted.length * .99)].toFixed(0) + " ms";
      }
      if (limits) say("Limit: " + limits.replaceAll(",", ", ") + (note ? ". " + note : ""), "limit");
      else if (note) say(note[0].toUpperCase() + note.slice(1) + ".", who === "nobody" ? "bad" : "");
      else say(who === "blend" ? "Your correction is added to the policy's actions." : "The arm follows you.", "moves");
    }
  };
  const begin = mode => {
    asking = true; show(); delays = [];
    say("Asking for the arm ...");
    send({begin: {mode, scale: el("rn-lead-scale").value / 100}});
  };
  el("rn-lead-open").onclick = () => { lead.classList.add("open"); show(); el("rn-lead-go").focus(); };
  el("rn-lead-close").onclick = () => { if (leads) send({back: 1}); lead.classList.remove("open"); el("rn-lead-open").focus(); };
  el("rn-lead-go").onclick = () => begin("person");
  el("rn-lead-blend").onclick = () => begin("blend");
  el("rn-lead-operate").onclick = () => send({operate: 1});
  el("rn-lead-back").onclick = () => send({back: 1});
  for (const id of ["rn-lead-turn", "rn-lead-tool"]) el(id).onclick = () => {
    const one = el(id); one.setAttribute("aria-pressed", one.getAttribute("aria-pressed") !== "true"); show();
  };
  el("rn-grip-open").onclick = () => { gripper = 1; };
  el("rn-grip-close").onclick = () => { gripper = 0; };
  el("rn-lead-scale").oninput = () => { el("rn-lead-percent").textContent = el("rn-lead-scale").value + " %"; };
  for (const [id, sign] of [["rn-joint-less", -1], ["rn-joint-more", 1]]) {
    const one = el(id), stop = () => { jog = 0; };
    one.addEventListener("pointerdown", () => { jog = sign; });
    for (const word of ["pointerup", "pointercancel", "pointerleave", "blur"]) one.addEventListener(word, stop);
    one.addEventListener("keydown", event => { if (event.key === "Enter") jog = sign; });
    one.addEventListener("keyup", stop);
  }
  for (const name of ["a", "b"]) {
    const one = el("rn-stick-" + name), knob = one.firstElementChild;
    const put = (x, y, held) => {
      sticks[name] = [x, y, held];
      knob.style.transform = `translate(${(x * 44).toFixed(1)}px, ${(-y * 44).toFixed(1)}px)`;
      one.classList.toggle("held", held);
    };
    const move = event => {
      const box = one.getBoundingClientRect(), half = box.width / 2;
      let x = (event.clientX - box.left - half) / half, y = -(event.clientY - box.top - half) / half;
      const far = Math.hypot(x, y);
      if (far > 1) { x /= far; y /= far; }
      put(Math.abs(x) < .08 ? 0 : x, Math.abs(y) < .08 ? 0 : y, true);
    };
    one.addEventListener("pointerdown", event => { if (leads) { one.setPointerCapture(event.pointerId); move(event); } });
    one.addEventListener("pointermove", event => { if (sticks[name][2]) move(event); });
    for (const word of ["pointerup", "pointercancel", "lostpointercapture"]) one.addEventListener(word, () => put(0, 0, false));
  }
  const isTyping = event => /^(INPUT|TEXTAREA|SELECT)$/.test(event.target.tagName) && event.target.type !== "range";
  addEventListener("keydown", event => {
    if (!leads || isTyping(event) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.code === "KeyO") gripper = 1;
    if (event.code === "KeyC") gripper = 0;
    if (/^(Space|Key[WASDRFQE]|Arrow)/.test(event.code)) { keys.add(event.code); event.preventDefault(); event.stopPropagation(); }
  }, true);
  addEventListener("keyup", event => {
    if (keys.delete(event.code) && leads) { event.preventDefault(); event.stopPropagation(); }
  }, true);
  const release = () => { keys.clear(); jog = 0; sample(); };
  addEventListener("blur", release);
  document.addEventListener("visibilitychange", release);
  const axis = (more, less) => (keys.has(more) ? 1 : 0) - (keys.has(less) ? 1 : 0);
  const pad = () => {
    for (const one of navigator.getGamepads ? navigator.getGamepads() : []) {
      if (!one || !one.connected) continue;
      const held = [4, 5].some(i => one.buttons[i] && one.buttons[i].pressed), dead = v => Math.abs(v) < .12 ? 0 : v;
      if (one.buttons[0] && one.buttons[0].pressed) gripper = 0;
      if (one.buttons[1] && one.buttons[1].pressed) gripper = 1;
      return [held, ...[0, 1, 2, 3].map(i => dead(one.axes[i]))];
    }
    return [false, 0, 0, 0, 0];
  };
  const sample = () => {
    if (!leads) return;
    const [padHeld, px, py, qx, qy] = document.hidden ? [false, 0, 0, 0, 0] : pad();
    const turn = el("rn-lead-turn").getAttribute("aria-pressed") === "true";
    const {a, b} = sticks;
    const held = !document.hidden && (keys.has("Space") || a[2] || b[2] || padHeld || jog !== 0);
    const forwards = a[1] - (padHeld ? py : 0), left = -a[0] - (padHeld ? px : 0);
    const up = b[1] - (padHeld ? qy : 0), about = -b[0] - (padHeld ? qx : 0);
    const clip = v => Number.isFinite(v) ? Math.max(-1, Math.min(1, v)) : v;
    const linear = [(turn ? 0 : forwards) + axis("KeyW", "KeyS"), (turn ? 0 : left) + axis("KeyA", "KeyD"), up + axis("KeyR", "KeyF")];
    const turns = [(turn ? -left : 0) + axis("KeyE", "KeyQ"), (turn ? forwards : 0) + axis("ArrowUp", "ArrowDown"), about + axis("ArrowLeft", "ArrowRight")];
    const n = ++number, now = performance.now();
    sent.set(n, now);
    if (sent.size > 300) sent.delete(sent.keys().next().value);
    const message = {n, t: now / 1000, held, tool: el("rn-lead-tool").getAttribute("aria-pressed") === "true", grip: gripper};
    if (jog) message.joint = [el("rn-lead-joint").value, jog * joints[el("rn-lead-joint").value]];
    else message.twist = [...linear.map(v => clip(v) * CONFIG.full[0]), ...turns.map(v => clip(v) * CONFIG.full[1])];
    send(message);
  };
  setInterval(sample, 1000 / CONFIG.rate);
  setInterval(connect, 500);
  window.rnLead = {delays: () => delays, send};
  show();
})();
"""  # noqa: E501


def key_html(key: str, joints: dict[str, float], *, labels: bool) -> str:
    """HTML element that tells the page that it may lead and label recordings.

    Args:
        key: key of its websocket.
        joints: speed of each joint while its button is held [rad/s, m/s]; empty if the robot cannot
            be led.
        labels: whether the page may label recordings.
    """
    told = escape(json.dumps(joints), quote=True)
    return (
        f'<div id="{_KEY_ID}" data-key="{escape(key, quote=True)}" data-joints="{told}" '
        f'data-labels="{int(labels)}"></div>'
    )


def with_lead(page: str) -> str:
    """The page with both panels added; they stay hidden until the page may lead or label."""
    config = {
        "key": _KEY_ID,
        "path": SOCKET_PATH,
        "protocol": PROTOCOL,
        "rate": RATE_HZ,
        "full": [FULL_M_S, FULL_RAD_S],
    }
    script = _SCRIPT.replace("(() => {", f"(() => {{ const CONFIG = {json.dumps(config)};", 1)
    style = f"<style>{_STYLE}{label_form.STYLE}</style>"
    page = page.replace("</head>", f"{style}</head>", 1)
    body = _BODY.replace("LABEL_OPEN", label_form.OPEN).replace("LABEL_BODY", label_form.BODY)
    scripts = f"<script>{script}</script><script>{label_form.SCRIPT}</script>"
    return page.replace("</body>", f"{body}{scripts}</body>", 1)
