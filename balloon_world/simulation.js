
// Appended to the page of a view, for a simulation: which policy drives, a map, and pushes that whoever watches gives.
for (const rule of [
  "#world { display: grid; grid-template-columns: 1fr 120px; gap: 8px; align-items: start; margin: 8px 0; }",
  "#world button { display: block; width: 100%; min-height: 40px; margin: 0 0 6px; padding: 4px 10px; font: inherit;"
    + " text-align: left; color: #e8e8e8; background: #2a2f34; border: 2px solid #2a2f34; border-radius: 6px; }",
  "#world button.on { border-color: #3b8fd4; }",
  "#map { width: 120px; height: 120px; background: #23282d; }",
  "#hint { grid-column: 1 / -1; }",
  ".real { display: none; }",
]) document.styleSheets[0].insertRule(rule, document.styleSheets[0].cssRules.length);

function element(tag, id, parent, more) {
  return parent.appendChild(Object.assign(document.createElement(tag), {id, ...more}));
}
const parts = document.createElement("div");
parts.id = "world";
$("missing").after(parts);
const hint = element("div", "hint", parts), choices = element("div", "choices", parts);
element("canvas", "map", parts, {width: 240, height: 240});
newsMs = 5000;  // a simulation that waits for a busy machine moves no car

function ask(what) {
  if (wire && wire.readyState === 1) { wire.send("ask " + what); put("answer", ""); }
}

simulated = m => {
  const w = m.world;
  if (!w) return;
  const ids = [...Object.keys(w.results).map(name => "drive " + name), ...w.levels.map(name => "level " + name), "next"];
  if (choices.childElementCount !== ids.length) {
    choices.replaceChildren();
    for (const id of ids) {
      element("button", id, choices).addEventListener("click", () => ask(id));
    }
  }
  for (const name in w.results) {
    const b = $("drive " + name), [hits, worlds] = w.results[name];
    b.textContent = name + (worlds ? ", undisturbed: hit " + hits + " of " + worlds : ": drive it");
    b.className = name === w.drives ? "on" : "";
  }
  for (const name of w.levels) {
    $("level " + name).textContent = name + " worlds";
    $("level " + name).className = name === w.level ? "on" : "";
  }
  put("next", "next world");
  const [pushedHits, pushed] = w.pushed;
  put("hint", "Push the car: arrow keys, or tap a side of the picture."
    + (pushed ? " Pushed: hit " + pushedHits + " of " + pushed + "." : ""));
  // The map has the car's way from below.
  const g = $("map").getContext("2d"), ways = [...w.path, w.balloon];
  const most = Math.max(1.5, ...ways.map(p => Math.max(Math.abs(p[1]) * 2, p[0]))), scale = 200 / most;
  const at = p => [120 - p[1] * scale, 220 - p[0] * scale];
  g.clearRect(0, 0, 240, 240);
  g.fillStyle = "#e33"; g.beginPath(); g.arc(...at(w.balloon), Math.max(6, 0.16 * scale), 0, 7); g.fill();
  g.strokeStyle = "#2ecc71"; g.lineWidth = 4; g.beginPath();
  w.path.forEach((p, i) => i ? g.lineTo(...at(p)) : g.moveTo(...at(p)));
  g.stroke();
  g.fillStyle = "#fff"; g.beginPath(); g.arc(...at(w.path[w.path.length - 1]), 6, 0, 7); g.fill();
};

document.addEventListener("keydown", e => {
  const side = {ArrowLeft: "left", ArrowRight: "right"}[e.key];
  if (side && !e.repeat) { e.preventDefault(); ask("push " + side); }
});
$("picture").addEventListener("pointerdown", e => {
  const box = e.target.getBoundingClientRect();
  ask("push " + (e.clientX < box.left + box.width / 2 ? "left" : "right"));
});
