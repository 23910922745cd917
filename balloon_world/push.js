
// Appended to the page of a simulation: whoever watches pushes the car off its way.
const hint = document.createElement("div");
$("choices").before(hint);
hint.style.gridColumn = "1 / -1";

function push(side) {
  ask("push " + side);
}

document.addEventListener("keydown", e => {
  const side = {ArrowLeft: "left", ArrowRight: "right"}[e.key];
  if (side && !e.repeat) { e.preventDefault(); push(side); }
});
$("picture").addEventListener("pointerdown", e => {
  const box = e.target.getBoundingClientRect();
  push(e.clientX < box.left + box.width / 2 ? "left" : "right");
});
setInterval(() => {
  const w = newest && newest.world;
  if (!w) return;
  const [recovered, pushes] = w.pushed;
  hint.textContent = "Push the car: arrow keys, or tap a side of the picture."
    + (pushes ? " Recovered from " + recovered + " of " + pushes + " pushes." : "");
}, 100);
