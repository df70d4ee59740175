"""The part of the page in which a person says how a recording went; HTML of our own, so that it is
a form for keyboards and screen readers.
"""

from __future__ import annotations

STYLE = """
#rn-label-open { margin-left: 8px; box-shadow: 0 2px 8px #0003; }
#rn-label-box { position: relative; width: min(480px, 100%); background: var(--rn-paper); border: 1px solid var(--rn-edge); border-radius: 10px;
  padding: 12px; box-sizing: border-box; box-shadow: 0 4px 18px #0003; display: none; max-height: calc(100dvh - var(--rn-bar) - 24px);
  overflow: auto; }
#rn-lead.labels #rn-label-box { display: block; }
#rn-lead.labels #rn-lead-open, #rn-lead.labels #rn-label-open, #rn-lead.open #rn-label-open { display: none; }
#rn-label-box h2 { font-size: 16px; margin: 0; }
#rn-label-box label.wide { display: block; width: fit-content; margin-top: 10px; }
#rn-label-box select, #rn-label-box textarea { width: 100%; box-sizing: border-box; margin-top: 4px; }
#rn-label-box textarea { font: inherit; border: 1px solid var(--rn-line); border-radius: 6px; padding: 8px 12px; background: var(--rn-paper);
  color: inherit; resize: vertical; min-height: 64px; }
#rn-label-box textarea:focus-visible, #rn-label-box input:focus-visible { outline: 3px solid var(--rn-blue); outline-offset: 2px; }
#rn-label-box fieldset { border: 0; padding: 0; margin: 10px 0 0; display: flex; flex-wrap: wrap; gap: 4px 18px; }
#rn-label-box legend { padding: 0; }
#rn-label-box fieldset label { min-height: 44px; cursor: pointer; }
#rn-label-box fieldset input { width: 20px; height: 20px; accent-color: var(--rn-blue); }
#rn-label-say { padding: 8px 10px; border-radius: 6px; background: var(--rn-soft); overflow-wrap: anywhere; flex: 1 1 100%; }
#rn-label-say.good { background: var(--rn-good); }
#rn-label-say.bad { background: var(--rn-bad); }
"""  # noqa: E501

OPEN = '<button id="rn-label-open" type="button" hidden>Label a recording</button>'
BODY = """
 <form id="rn-label-box" aria-labelledby="rn-label-title">
  <div class="row"><h2 id="rn-label-title">How did it go?</h2><span class="grow"></span>
   <button id="rn-label-close" type="button" aria-label="Close this panel">&times;</button></div>
  <label class="wide" for="rn-label-run">Recording</label><select id="rn-label-run"></select>
  <fieldset><legend>Outcome</legend>
   <label><input type="radio" name="rn-outcome" value="success"> Success</label>
   <label><input type="radio" name="rn-outcome" value="failure"> Failure</label>
   <label><input type="radio" name="rn-outcome" value="unknown"> Unknown</label>
  </fieldset>
  <label class="wide" for="rn-label-comment">Comment</label><textarea id="rn-label-comment" rows="2" maxlength="500"></textarea>
  <div class="row">
   <button id="rn-label-save" type="submit" class="main">Save the label</button>
   <button id="rn-label-operate" type="button" hidden>Become the operator</button>
   <div id="rn-label-say" role="status" hidden></div>
  </div>
 </form>
"""  # noqa: E501

SCRIPT = """
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
    if (asked) return;  // a disabled button would lose the focus
    const outcome = [...document.getElementsByName("rn-outcome")].find(one => one.checked);
    asked = {run: runs.value, outcome: outcome ? outcome.value : "unknown", comment: el("rn-label-comment").value};
    say("Saving ...");
    rnLead.send({label: asked});
  };
  addEventListener("rn-told", event => {
    const told = event.detail;
    if (told.recordings) list(told.recordings);
    if (told.operates && isOpen()) { el("rn-label-operate").hidden = true; say("You operate the robot now. Save the label."); }
    if (told.labelled === undefined) return;
    const mine = asked;
    asked = null;
    el("rn-label-operate").hidden = !/take_over/.test(told.text);
    if (told.text) { say(told.text, "bad"); return; }
    say("Saved: " + told.labelled + ", " + mine.outcome + ".", "good");
    rnLead.send({recordings: 1});
  });
  addEventListener("rn-lost", () => { if (asked) { asked = null; say("The connection is lost. Save it again.", "bad"); } });
})();
"""  # noqa: E501
