(() => {
  const el = id => document.getElementById(id), panel = el("rn-records"), body = el("rn-records-body"), said = el("rn-records-say");
  const wait = ms => new Promise(done => setTimeout(done, ms));
  const openers = {alarms: el("rn-alarms-open"), tasks: el("rn-tasks-open"), service: el("rn-service-open")};
  const titles = {alarms: "Alarms", tasks: "Past tasks", service: "Maintenance"};
  const words = {robot: "robot", perception: "camera", inference: "policy", control: "control"};
  let key = "", shown = "", state = null, drawn = "", known = null, failures = 0, most = 20;
  const pictures = new Map();
  const make = (tag, text = "", name = "") => {
    const one = document.createElement(tag);
    if (text) one.textContent = text;
    if (name) one.className = name;
    return one;
  };
  const time = s => {
    const at = new Date(s * 1000), isToday = at.toDateString() === new Date().toDateString();
    return (isToday ? "" : at.toLocaleDateString() + " ") + at.toLocaleTimeString([], {hour: "2-digit", minute: "2-digit", second: "2-digit"});
  };
  const say = text => { said.textContent = text; };
  const get = path => fetch(CONFIG.path + path, {headers: {[CONFIG.header]: key}, cache: "no-store", signal: AbortSignal.timeout(15000)});
  const ask = async path => {
    const answer = await get(path), told = await answer.json();
    if (!answer.ok) throw new Error(told.text || answer.statusText);
    return told;
  };
  const act = async (path, then) => {
    say("");
    try { await ask(path); } catch (error) { say(error.message); await look(); return; }
    await look();  // draws what `then` focuses
    then();
  };
  const button = (text, label, press, name = "") => {
    const one = make("button", text, name);
    one.type = "button";
    one.setAttribute("aria-label", label);
    one.onclick = press;
    return one;
  };
  const alarmRow = alarm => {
    const row = make("li", "", alarm.is_open ? (alarm.is_warning ? "warn" : "bad") : "");
    const often = alarm.count > 1 ? ", " + alarm.count + " times" : "";
    row.append(make("strong", (alarm.is_warning ? "Warning: " : "Alarm: ") + alarm.source + ", " + alarm.what + often));
    const at = time(alarm.first_s) + (alarm.count > 1 ? " to " + time(alarm.last_s) : "");
    row.append(make("div", at + (alarm.over_s ? ", normal again since " + time(alarm.over_s) : ""), "dim"));
    row.append(make("div", alarm.cause));
    row.append(make("div", "What to do: " + alarm.advice));
    if (!alarm.is_open) row.append(make("div", "Acknowledged by " + alarm.acknowledged_by + ", " + time(alarm.acknowledged_s), "dim"));
    else if (state.may_operate) {
      const one = button("Acknowledge", "Acknowledge: " + alarm.source + ", " + alarm.what, () =>
        act("acknowledge?alarm=" + alarm.number, () => { const next = body.querySelector("li button"); (next || el("rn-records-title")).focus(); }));
      one.dataset.alarm = alarm.number;
      row.append(one);
    } else row.append(make("div", "Only an operator can acknowledge it.", "dim"));
    return row;
  };
  const drawAlarms = () => {
    const list = make("ul"), held = document.activeElement && document.activeElement.dataset.alarm;
    for (const alarm of state.alarms) list.append(alarmRow(alarm));
    body.replaceChildren(state.alarms.length ? list : make("p", "No alarms."));
    const again = held && body.querySelector(`[data-alarm="${held}"]`);
    if (again) again.focus();
  };
  const drawService = () => {
    const out = state.maintenance;
    if (out) {
      body.replaceChildren(make("p", out + "."), make("p", "Every call that acts is refused, and the emergency stop is latched. It stays latched when the robot is put back in service: a person releases it with the command at the top of this page. Nothing moves before a new start.", "dim"));
      if (state.may_end) body.append(button("Put back in service", "Put the robot back in service", () =>
        act("maintenance?end=1", () => say("In service. The emergency stop is still latched: the command that releases it is at the top of this page.")), "main"));
      else body.append(make("p", "Only an admin can put it back in service.", "dim"));
      return;
    }
    body.replaceChildren(make("p", "The robot is in service. While it is out of service, no agent, policy or task can move it, not even after a restart."));
    if (!state.may_operate) { body.append(make("p", "Only an operator can take it out of service.", "dim")); return; }
    const form = make("form"), label = make("label", "Reason"), why = make("input");
    why.id = "rn-service-why"; why.maxLength = 200; why.required = true; why.autocomplete = "off";
    label.htmlFor = why.id;
    const send = button("Take out of service", "Take the robot out of service", null, "main");
    send.type = "submit"; send.style.marginTop = "10px";
    form.append(label, why, send);
    form.onsubmit = event => { event.preventDefault(); act("maintenance?begin=" + encodeURIComponent(why.value), () => el("rn-records-title").focus()); };
    body.append(form);
  };
  const picture = async (place, task, end) => {
    const number = task.number, text = end ? "end" : "start";
    if (!task.pictures[end]) { place.replaceChildren(make("figcaption", "no picture of the " + text, "dim")); return; }
    const name = number + end;
    if (!pictures.has(name)) {
      const answer = await get("picture?task=" + number + "&end=" + end).catch(() => null);
      pictures.set(name, answer && answer.ok ? URL.createObjectURL(await answer.blob()) : "");
    }
    const url = pictures.get(name);
    if (url) {
      const image = make("img");
      image.src = url; image.alt = "Camera at the " + text;
      place.replaceChildren(image, make("figcaption", text, "dim"));
    } else place.replaceChildren(make("figcaption", "no picture of the " + text, "dim"));
  };
  const taskRow = task => {
    const isGood = task.outcome === "succeeded", isBad = ["failed", "timed_out", "error"].includes(task.outcome);
    const row = make("li", "", isGood ? "good" : isBad ? "bad" : "");
    row.append(make("strong", (isGood ? "\u2713 " : isBad ? "\u2717 " : "") + task.outcome.replace("_", " ") + ": " + task.instruction));
    const tries = task.attempts > 1 ? ", " + task.attempts + " attempts" : "";
    row.append(make("div", time(task.at_s) + ", " + task.took_s.toFixed(1) + " s" + tries + (task.model ? ", " + task.model : ""), "dim"));
    if (task.reason) row.append(make("div", task.reason));
    const shots = make("div", "", "shots"), places = [0, 1].map(() => make("figure"));
    shots.append(...places); row.append(shots);
    places.forEach((place, end) => picture(place, task, end));
    return row;
  };
  const drawTasks = told => {
    body.replaceChildren();
    if (!told.tasks.length) { body.append(make("p", "There are no past tasks.")); return; }
    if (told.rates.length) {
      const table = make("table"), head = make("tr");
      for (const text of ["model", "instruction", "succeeded", "95 % interval", "median"]) {
        const cell = make("th", text); cell.scope = "col"; head.append(cell);
      }
      table.append(head);
      for (const rate of told.rates.slice(0, 12)) {
        const row = make("tr"), part = v => (100 * v).toFixed(0);
        for (const text of [rate.model || "?", rate.instruction, rate.succeeded + " of " + rate.judged, part(rate.low) + " to " + part(rate.high) + " %",
          rate.median_s === null ? "" : rate.median_s.toFixed(1) + " s"]) row.append(make("td", text));
        table.append(row);
      }
      body.append(make("h3", "Success rate by model and instruction"), table);
    }
    const list = make("ul");
    for (const task of told.tasks.slice(0, most)) list.append(taskRow(task));
    body.append(make("h3", "Tasks, newest first"), list);
    if (told.tasks.length > most) body.append(button("Show more", "Show more tasks", () => { most += 20; drawTasks(told); }));
  };
  const loadTasks = async () => {
    try { const told = await ask("tasks"); if (shown === "tasks") drawTasks(told); } catch (error) { say(error.message); }
  };
  const draw = () => {
    const is = JSON.stringify([shown, state.may_operate, state.may_end, shown === "alarms" ? state.alarms : state.maintenance]);
    if (is === drawn) return;
    drawn = is;
    if (shown === "alarms") drawAlarms();
    if (shown === "service") drawService();
  };
  const open = what => {
    shown = what; drawn = ""; say("");
    panel.classList.toggle("open", !!what);
    for (const [name, one] of Object.entries(openers)) one.setAttribute("aria-expanded", String(name === what));
    if (!what) return;
    el("rn-records-title").textContent = titles[what];
    body.replaceChildren();
    if (what === "tasks") loadTasks(); else draw();
    el("rn-records-title").focus();
  };
  const close = () => { const opener = openers[shown]; open(""); if (opener) opener.focus(); };
  for (const [name, one] of Object.entries(openers)) one.onclick = () => shown === name ? close() : open(name);
  el("rn-records-close").onclick = close;
  panel.addEventListener("keydown", event => { if (event.key === "Escape") close(); });
  const glance = () => {
    const place = el("rn-glance"), parts = [];
    place.classList.toggle("limit", !!state.limit);
    if (state.limit) { place.textContent = "Limit: " + state.limit; place.title = state.limit; return; }
    place.title = "";
    for (const one of state.modules) {
      const isBad = !["ok", "stopped", "starting", "stopping", "waiting"].includes(one.health);
      const part = make("span", "", isBad ? "bad" : ""), name = words[one.kind] || one.kind;
      part.append(make("b", name), " " + (one.health !== "ok" ? one.health : [one.rate_hz === null ? "" : one.rate_hz.toFixed(0) + " Hz",
        one.latency_ms === null ? "" : one.latency_ms.toFixed(0) + " ms"].filter(text => text).join(" ")));
      if (isBad) part.append("!");
      parts.push(part, " \u00b7 ");
    }
    place.replaceChildren(...parts.slice(0, -1));
  };
  const strip = () => {
    const alarms = state.alarms || [], opened = alarms.filter(one => one.is_open), bad = opened.filter(one => !one.is_warning), one = openers.alarms;
    openers.alarms.hidden = !state.alarms;
    const first = bad[0] || opened[0];
    one.className = bad.length ? "bad" : opened.length ? "warn" : "";
    const word = bad.length ? "alarm" : "warning", count = opened.length;
    one.textContent = count ? count + " " + word + (count > 1 ? "s" : "") + ": " + first.source + ", " + first.what : "No alarms";
    openers.tasks.hidden = !state.has_tasks;
    openers.service.hidden = typeof state.maintenance !== "string";
    openers.service.textContent = state.maintenance ? "Out of service" : "Maintenance";
    openers.service.className = state.maintenance ? "out" : "";
    openers.service.title = state.maintenance || "";
    const fresh = known && opened.find(alarm => !known.has(alarm.number));
    if (fresh) el("rn-alert").textContent = (fresh.is_warning ? "Warning: " : "Alarm: ") + fresh.source + ", " + fresh.what + ". " + fresh.cause;
    known = new Set(alarms.map(alarm => alarm.number));
  };
  const look = async () => {
    const found = rnPage.page ? rnPage.page.key : "";
    if (found !== key) { key = found; known = null; delete document.documentElement.dataset.robot; if (!found) open(""); }
    document.documentElement.classList.toggle("rn-strip", !!key);
    if (!key) return;
    try {
      state = await ask("state");
      failures = 0;
    } catch (error) {
      if (++failures > 2) { el("rn-glance").className = "limit"; el("rn-glance").textContent = "Not up to date: " + error.message; }
      return;
    }
    strip(); glance();
    const robot = state.modules.find(one => one.kind === "robot");
    document.documentElement.dataset.robot = robot ? robot.health : "";
    if (shown === "alarms" || shown === "service") draw();
    if (shown === "tasks" && !body.firstChild) { say(""); loadTasks(); }  // the first request failed
  };
  new MutationObserver(() => { if ((rnPage.page ? rnPage.page.key : "") !== key) look(); })
    .observe(document.getElementById("root"), {childList: true, subtree: true});
  (async () => { for (;;) { await look(); await wait(document.hidden ? 5000 : 1000); } })();
})();
