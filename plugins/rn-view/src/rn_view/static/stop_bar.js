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
  const show = (word, text, command = "") => {
    bar.className = word;
    document.body.dataset.stopping = pressing;
    if (state.textContent === text + command) return;
    state.textContent = text;
    if (!command) return;
    const code = document.createElement("code");
    code.textContent = command;
    state.append(code);
  };
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
        show("lost", "NOT STOPPED BY THIS PAGE: " + error.message + ". Use the robot's own stop. Retrying ...");
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
      const which = names.length > 1 ? ": " + held.join(", ") : "";
      if (!held.length) show("", CONFIG.ready);
      else show("latched", "STOPPED" + which + ". A person releases it in a terminal on " + CONFIG.machine + ":",
        held.map(name => CONFIG.release[name]).join("\n"));
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
      one.setAttribute("aria-label", "Close this notification");
    for (const one of document.querySelectorAll("#root button.mantine-ActionIcon-root:not([aria-label])"))
      one.setAttribute("aria-label", "Settings of the view");
    for (const one of document.querySelectorAll("#root input:not([aria-label]), #root textarea:not([aria-label])")) {
      if (one.labels && one.labels.length) continue;
      const row = one.closest("[class*=Flex],[class*=Grid],[class*=Group]") || one.parentElement.parentElement;
      let place = row, text = "";
      for (let up = 0; place && up < 4 && !text; up++) {
        text = (place.querySelector("label") || place).innerText.trim().split("\n")[0];
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
