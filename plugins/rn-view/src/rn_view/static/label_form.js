(() => {
  const el = id => document.getElementById(id), panel = el("rn-lead"), runs = el("rn-label-run"), said = el("rn-label-say");
  let known = [], asked = null;
  const say = (text, word = "") => { said.hidden = !text; said.textContent = text; said.className = word; };
  const isOpen = () => panel.classList.contains("labels");
  const name = run => {
    const begun = new Date(run.begun_at);
    return run.id + (isNaN(begun) ? "" : ", " + begun.toLocaleTimeString([], {hour: "2-digit", minute: "2-digit"})) + ", " + (run.outcome || "unknown");
  };
  const choose = () => {
    const run = known.find(one => one.id === runs.value);
    for (const one of document.getElementsByName("rn-outcome")) one.checked = !!run && one.value === (run.outcome || "unknown");
    el("rn-label-comment").value = run ? run.note : "";
    el("rn-label-save").disabled = !run;
  };
  const list = told => {
    const chosen = runs.value, isSame = known.some(one => one.id === chosen);
    known = told.filter(run => run.kind === "recording" && run.state !== "recording");
    runs.replaceChildren(...known.map(run => new Option(name(run), run.id)));
    if (isSame) runs.value = chosen;
    choose();
    if (!known.length) say("There is no finished recording.");
  };
  const close = () => { panel.classList.remove("labels"); el("rn-label-open").focus(); };
  el("rn-label-open").onclick = () => {
    panel.classList.add("labels"); say(""); runs.value = ""; choose(); rnLead.send({recordings: 1}); runs.focus();
  };
  el("rn-label-close").onclick = close;
  el("rn-label-box").addEventListener("keydown", event => { if (event.key === "Escape") close(); });
  el("rn-label-operate").onclick = () => rnLead.send({operate: 1});
  runs.onchange = () => { say(""); choose(); };
  el("rn-label-box").onsubmit = event => {
    event.preventDefault();
    if (asked) return;  // not by disabling the button, which would lose the focus
    const outcome = [...document.getElementsByName("rn-outcome")].find(one => one.checked);
    asked = {run: runs.value, outcome: outcome ? outcome.value : "unknown", comment: el("rn-label-comment").value};
    say("Saving ...");
    rnLead.send({label: asked});
  };
  addEventListener("rn-told", event => {
    const told = event.detail;
    if (told.recordings) list(told.recordings);
    if (told.operates && isOpen()) { el("rn-label-operate").hidden = true; say("You are the operator now. Save the label."); }
    if (told.labelled === undefined) return;
    const mine = asked;
    asked = null;
    el("rn-label-operate").hidden = !/take_over/.test(told.text);
    if (told.text) { say(told.text, "bad"); return; }
    say("Saved: " + told.labelled + ", " + mine.outcome + ".", "good");
    rnLead.send({recordings: 1});
  });
  addEventListener("rn-lost", () => { if (asked) { asked = null; say("The connection is lost. Save the label again.", "bad"); } });
})();
