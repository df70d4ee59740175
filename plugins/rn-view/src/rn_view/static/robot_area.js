(() => {
  const el = id => document.getElementById(id), cameras = el("rn-cameras"), cover = el("rn-wait"), count = "rn-reloads";
  let socket = null, key = "", held = {page: null, lead: null}, isFolded = false, tiles = [], shownAt = performance.now(), isProbing = false;
  const tile = camera => {
    const figure = document.createElement("figure"), image = new Image(), name = document.createElement("figcaption"), old = document.createElement("div");
    figure.style.setProperty("--ratio", camera.width / camera.height);
    name.textContent = camera.label;
    image.alt = "Camera " + camera.label;
    old.className = "rn-old";
    old.textContent = "Waiting for the camera ...";
    figure.append(image, name, old);
    cameras.append(figure);
    return {image, old, at: 0};
  };
  const draw = (own, data) => {
    const number = new Uint8Array(data, 0, 1)[0], one = tiles[number];
    const url = URL.createObjectURL(new Blob([new Uint8Array(data, 1)], {type: "image/jpeg"}));
    one.image.onload = one.image.onerror = event => {
      URL.revokeObjectURL(url);
      if (event.type === "load") { one.at = performance.now(); one.old.textContent = ""; }
      if (own.readyState === 1) own.send(String(number));  // the server sends the next one
    };
    one.image.src = url;
  };
  const read = () => {  // viser removes these elements while its panel is folded
    const page = el(CONFIG.id), lead = el(CONFIG.lead);
    if (page && (!held.page || page.dataset.key !== held.page.key)) held = {page: {...page.dataset}, lead: null};
    if (held.page && lead) held.lead = {...lead.dataset};
  };
  const drop = refused => {
    if (!held.page || held.page.key !== refused) return;
    held = {page: null, lead: null};
    const place = el(CONFIG.id);
    if (place && place.dataset.key === refused) place.remove();
  };
  const connect = () => {
    const found = held.page ? held.page.key : "";
    if (found === key && (!key || (socket && socket.readyState < 2))) return;
    if (socket) socket.close();
    socket = null;
    if (found !== key) { tiles = []; cameras.replaceChildren(); }
    key = found;
    if (!key) return;
    const own = socket = new WebSocket(location.origin.replace("http", "ws") + CONFIG.pictures + "?key=" + encodeURIComponent(key), [CONFIG.protocol]);
    own.binaryType = "arraybuffer";
    own.onclose = event => { if (event.code === CONFIG.unknown) drop(found); };
    own.onmessage = event => {
      if (own !== socket) return;
      if (typeof event.data !== "string") { draw(own, event.data); return; }
      cameras.replaceChildren();
      tiles = JSON.parse(event.data).map(tile);
    };
  };
  const isAnswered = () => fetch(CONFIG.state, {cache: "no-store", signal: AbortSignal.timeout(5000)}).then(answer => answer.ok, () => false);
  const reload = async () => {  // never while the server is away: the stop above would be lost
    const reloads = Number(sessionStorage.getItem(count) || 0);
    if (isProbing || document.body.dataset.stopping || performance.now() - shownAt < CONFIG.reload_s * 1000 * 2 ** Math.min(reloads, 4)) return;
    isProbing = true;
    const isHere = await isAnswered();
    isProbing = isHere && !held.page && !document.querySelector("#root [data-rn-shown]");
    if (!isProbing) return;
    sessionStorage.setItem(count, reloads + 1);
    location.reload();
  };
  const look = () => {
    read();
    const now = performance.now(), isShown = !!held.page || !!document.querySelector("#root [data-rn-shown]"), health = document.documentElement.dataset.robot;
    connect();
    if (!CONFIG.live) { cover.hidden = isShown; return; }
    for (const one of tiles) if (one.at && now - one.at > CONFIG.old_s * 1000) one.old.textContent = "No new picture for " + Math.round((now - one.at) / 1000) + " s";
    const waits = isShown && health && health !== "ok";
    cover.hidden = isShown && !waits;
    cover.classList.toggle("note", isShown);
    const text = "Waiting for the robot ..." + (waits ? " (" + health + "; what is shown is not measured)" : "");
    if (cover.textContent !== text) cover.textContent = text;
    if (isShown) { shownAt = now; sessionStorage.removeItem(count); } else reload();
    const handle = isFolded || !held.page || innerWidth > 576 ? null : document.querySelector("#root .mantine-Paper-root [style*='cursor: pointer']");
    if (handle) { isFolded = true; handle.click(); }  // on a phone viser's panel cannot be folded by the server
  };
  window.rnPage = {get page() { return held.page; }, get lead() { return held.lead; }};
  new MutationObserver(look).observe(el("root"), {childList: true, subtree: true});
  setInterval(look, 500);
  look();
})();
