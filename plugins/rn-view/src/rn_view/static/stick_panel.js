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
    const place = rnPage.lead, found = place ? place.key : "";
    lead.classList.toggle("there", !!found || leads);
    el("rn-label-open").hidden = !found || place.labels !== "1";
    el("rn-lead-open").hidden = !!found && place.joints === "{}";
    if (!found || (found === key && socket && socket.readyState < 2)) return;
    if (socket) socket.close();
    key = found;
    const limits = JSON.parse(place.joints);
    joints = limits;
    el("rn-lead-joint").replaceChildren(...Object.keys(limits).map(name => new Option(name, name)));
    const own = socket = new WebSocket(location.origin.replace("http", "ws") + CONFIG.path + "?key=" + encodeURIComponent(key), [CONFIG.protocol]);
    own.onopen = () => { show(); if (lead.classList.contains("open")) send({fold: true}); };
    own.onmessage = event => { if (own === socket) hear(JSON.parse(event.data)); };
    own.onclose = () => {
      if (own !== socket) return;
      if (leads) say("The connection is lost, and the arm brakes. Start again once the page is connected.", "bad");
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
      mayOperate = false; say("You are the operator now. Lead the arm when you are ready."); show();
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
    say("Requesting the arm ...");
    send({begin: {mode, scale: el("rn-lead-scale").value / 100}});
  };
  const open = isOpen => {
    lead.classList.toggle("open", isOpen);
    document.documentElement.classList.toggle("rn-leading", isOpen);
    send({fold: isOpen});
    show();
    el(isOpen ? "rn-lead-go" : "rn-lead-open").focus();
  };
  el("rn-lead-open").onclick = () => open(true);
  el("rn-lead-close").onclick = () => { if (leads) send({back: 1}); open(false); };
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
