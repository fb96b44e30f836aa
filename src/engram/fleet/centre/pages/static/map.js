"use strict";
// The map from above, one part at a time: how its parts lie to each other is unknown.
const [canvas, colour, slider, at, fresh, count, parts, relation, card, legend] = [
  "canvas", "colour", "slider", "at", "new", "count", "parts", "relation", "card", "legend",
].map((id) => document.getElementById(id));
// So many parts have a button; N goes through the nodes of the others.
const BUTTONS = 12;
const PALE = "#d9dee3";
const INK = "#1b2733";

let shown = null; // what the server sent of a revision; null until it did
let part = 0; // the one that is shown
let view = null; // metres at the middle, and pixels a metre
let chosen = -1; // place of a node in the columns of `shown`
let steps = 0; // asked for before the nodes came
let asked = 0;

const colours = () => weakHere()?.colours || shown.by[colour.value];
const isFresh = (i) => !fresh.checked || shown.added[i] === shown.revision;
const sharpness = () => window.devicePixelRatio || 1;

// The middle of some nodes, and pixels a metre at which a sheet shows them, and `least` metres.
function fitted(sheet, some, least = 5) {
  if (!some.length) return { x: 0, y: 0, scale: 1 };
  let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const i of some) {
    x0 = Math.min(x0, shown.x[i]); x1 = Math.max(x1, shown.x[i]);
    y0 = Math.min(y0, shown.y[i]); y1 = Math.max(y1, shown.y[i]);
  }
  const scale = 0.88 * Math.min(sheet.width / Math.max(x1 - x0, least), sheet.height / Math.max(y1 - y0, least));
  return { x: (x0 + x1) / 2, y: (y0 + y1) / 2, scale };
}

const px = (sheet, eye, x) => sheet.width / 2 + (x - eye.x) * eye.scale;
const py = (sheet, eye, y) => sheet.height / 2 - (y - eye.y) * eye.scale;

// Chains of nodes as lines, in the direction of the drives; their nodes as dots.
function paint(sheet, eye, number, isWhole) {
  const brush = sheet.getContext("2d"), labels = colours(), dpr = sharpness();
  brush.fillStyle = "#fff";
  brush.fillRect(0, 0, sheet.width, sheet.height);
  if (isWhole) paintWeak(sheet, eye, number);
  const dot = (isWhole ? Math.max(3, Math.min(6, eye.scale * 0.5 / dpr)) : 2) * dpr;
  const spacing = sheet.width / 10;
  const ends = new Map();
  brush.lineWidth = 1.4 * dpr;
  for (const i of shown.members[number]) {
    const x = px(sheet, eye, shown.x[i]), y = py(sheet, eye, shown.y[i]), label = labels.of[i];
    const ink = isFresh(i) ? labels.colours[label] : PALE;
    const end = ends.get(shown.chain[i]);
    let way = spacing / 2;
    brush.fillStyle = brush.strokeStyle = ink;
    if (end && end.label === label) {
      brush.beginPath(); brush.moveTo(end.x, end.y); brush.lineTo(x, y); brush.stroke();
      way = end.way + Math.hypot(x - end.x, y - end.y);
      if (isWhole && way >= spacing) { arrow(brush, end, x, y, dot / 2 + 5 * dpr); way = 0; }
    }
    ends.set(shown.chain[i], { x, y, label, way });
    brush.fillRect(x - dot / 2, y - dot / 2, dot, dot);
  }
  if (!isWhole) return;
  mark(sheet, eye, number, dot);
  numberWeak(sheet, eye, number);
}

function arrow(brush, from, x, y, size) {
  const heading = Math.atan2(y - from.y, x - from.x);
  brush.beginPath();
  for (const turn of [0, 2.5, -2.5])
    brush.lineTo(x + size * Math.cos(heading + turn), y + size * Math.sin(heading + turn));
  brush.fill();
}

function ring(brush, x, y, radius, fill) {
  brush.beginPath(); brush.arc(x, y, radius, 0, 7);
  if (fill) { brush.fillStyle = fill; brush.fill(); }
  brush.stroke();
}

// Starts of drives, goals, the chosen node.
function mark(sheet, eye, number, dot) {
  const brush = sheet.getContext("2d"), labels = colours(), dpr = sharpness();
  const place = (x, y) => [px(sheet, eye, x), py(sheet, eye, y)];
  brush.lineWidth = 2 * dpr;
  for (const i of shown.starts)
    if (shown.part[i] === number && isFresh(i)) {
      brush.strokeStyle = labels.colours[labels.of[i]];
      ring(brush, ...place(shown.x[i], shown.y[i]), 5 * dpr, "#fff");
    }
  brush.fillStyle = INK;
  brush.font = `${13 * dpr}px system-ui`;
  for (const [name, of, x, y] of shown.goals)
    if (of === number) brush.fillText(`★ ${name}`, ...place(x, y));
  if (chosen >= 0 && shown.part[chosen] === number) {
    brush.strokeStyle = "#000";
    ring(brush, ...place(shown.x[chosen], shown.y[chosen]), dot + 4 * dpr);
  }
  scaleBar(brush, sheet, eye, dpr);
}

function scaleBar(brush, sheet, eye, dpr) {
  const metres = 10 ** Math.floor(Math.log10((sheet.width * 0.3) / eye.scale));
  const y = sheet.height - 14 * dpr;
  brush.fillStyle = INK;
  brush.fillRect(12 * dpr, y, metres * eye.scale, 3 * dpr);
  brush.font = `${13 * dpr}px system-ui`;
  brush.fillText(`${metres} m`, 12 * dpr, y - 6 * dpr);
}

function draw() {
  if (!shown) return;
  paint(canvas, view, part, true);
  const some = shown.members[part].filter(isFresh), labels = colours();
  colour.disabled = labels !== shown.by[colour.value];
  const counts = labels.names.map(() => 0);
  for (const i of some) counts[labels.of[i]] += 1;
  const all = counted(shown.node.length, "node"), several = shown.parts.length > 1;
  const here = several ? `${some.length} of ${all}, in part ${part + 1} of ${shown.parts.length}` : counted(some.length, "node");
  count.textContent = shown.node.length ? here : "no nodes yet";
  const items = labels.names.map((name, k) => [name, labels.colours[k], counts[k]]).filter(([, , n]) => n > 0);
  legend.replaceChildren(...items.map(([name, ink, n]) => {
    const item = document.createElement("li"), dot = document.createElement("i");
    dot.style.background = ink;
    item.append(dot, `${name} (${counted(n, "node")})`);
    return item;
  }));
  if (some.length) legend.append(Object.assign(document.createElement("li"), { textContent: "○ first node of a drive" }));
  if (weakHere()?.spots.length) legend.append(Object.assign(document.createElement("li"), { textContent: "broad, numbered: weak spot, broader the more is missed" }));
}

// A button with a small drawing for each part, where there are several.
function drawParts() {
  const several = shown.parts.length > 1;
  parts.hidden = !several;
  tellRelation();
  const rest = shown.parts.slice(BUTTONS);
  const buttons = several ? shown.parts.slice(0, BUTTONS).map(partButton) : [];
  parts.replaceChildren(...buttons);
  if (rest.length) {
    const nodes = rest.reduce((sum, one) => sum + one, 0);
    parts.append(`and ${counted(rest.length, "smaller part")} (${counted(nodes, "node")}): N goes through them`);
  }
  buttons.forEach((button, number) => paint(button.firstChild, fitted(button.firstChild, shown.members[number]), number, false));
}

function partButton(nodes, number) {
  const button = document.createElement("button"), sheet = document.createElement("canvas");
  sheet.width = 110 * sharpness(); sheet.height = 60 * sharpness();
  button.append(sheet, `part ${number + 1} of ${shown.parts.length}`, document.createElement("br"), counted(nodes, "node"));
  button.setAttribute("aria-pressed", String(number === part));
  button.addEventListener("click", () => show(number));
  return button;
}

// What joins the part that is shown, and what the others.
function tellRelation() {
  const pieces = shown.pieces[part] || 0, said = [];
  if (pieces > 1) said.push(`No drive joins the ${pieces} pieces shown: anchors hold them together.`);
  if (shown.parts.length > 1) said.push("How the parts lie to each other is unknown: neither drives nor anchors join them. One is shown at a time.");
  relation.textContent = said.join(" ");
  relation.hidden = !said.length;
}

function show(number) {
  part = number;
  view = fitted(canvas, shown.members[part]);
  [...parts.children].forEach((button, k) => button.setAttribute("aria-pressed", String(k === part)));
  tellRelation();
  draw();
}

function fact(name, value) {
  const term = document.createElement("dt"), said = document.createElement("dd");
  term.textContent = name;
  said.append(value);
  return [term, said];
}

async function choose(i) {
  chosen = i;
  if (shown.part[i] !== part) show(shown.part[i]);
  draw();
  const node = shown.node[i], drive = shown.by.experience;
  const found = await send("GET", `/v1/maps/${map}/blame/${node}`);
  if (chosen !== i || shown.node[i] !== node) return;
  const list = document.createElement("dl");
  const dated = /^\d{4}-/.test(found.when); // a robot without a date counts from its start
  list.append(...fact("node", found.node), ...fact("drive", drive.names[drive.of[i]]),
    ...fact("saved", dated ? timeOf(found.when) : found.when), ...fact("driven", `${Number(found.driven_m).toFixed(1)} m`),
    ...fact("added by", `revision ${found.revision}`), ...fact("matched", `${found.matches} of ${counted(found.attempts, "attempt")}`),
    ...fact("paths", String(found.paths)));
  card.replaceChildren(pictureOf(node, `What ${found.robot} saw here`), list);
}

// The next node, part by part; before the nodes came, it is remembered.
function step(by) {
  if (!shown || asked !== shown.asked) { steps += by; return; }
  const order = shown.order;
  if (!order.length) return;
  const from = chosen < 0 ? (by > 0 ? -1 : 0) : order.indexOf(chosen);
  trying(() => choose(order[(from + by + order.length) % order.length]))(new Event("step"));
}

async function load() {
  const mine = ++asked;
  count.textContent = "loading…";
  const found = await send("GET", `/maps/${map}/nodes?at=${slider.value}`);
  if (mine !== asked) return;
  const before = shown, node = before && chosen >= 0 ? before.node[chosen] : null;
  const root = before && before.members[part] ? before.node[before.members[part][0]] : null;
  found.members = found.parts.length ? found.parts.map(() => []) : [[]];
  found.part.forEach((number, i) => found.members[number].push(i));
  found.order = found.members.flat();
  const newest = new Map();
  found.before = found.chain.map((chain, i) => { // the node before it in its drive
    const before = newest.get(chain);
    newest.set(chain, i);
    return before;
  });
  found.asked = mine;
  shown = found;
  chosen = shown.node.indexOf(node);
  // The part that was shown stays, and the view with it while some of it is in sight.
  part = Math.max(shown.part[shown.node.indexOf(root)] || 0, 0);
  if (!view || !root || !inSight()) view = fitted(canvas, shown.members[part]);
  turnToFresh();
  drawParts();
  draw();
  if (weakSwitch.checked) loadWeak();
  if (steps) { const by = steps; steps = 0; step(by); }
}

// To the part with most of what the revision added, if the one that is shown has none of it.
function turnToFresh() {
  const sizes = shown.members.map((some) => some.filter(isFresh).length);
  const most = Math.max(...sizes);
  if (most && !sizes[part]) show(sizes.indexOf(most));
}

function inSight() {
  return (shown.members[part] || []).some((i) => {
    const x = px(canvas, view, shown.x[i]), y = py(canvas, view, shown.y[i]);
    return x > 0 && x < canvas.width && y > 0 && y < canvas.height;
  });
}

function resize() {
  canvas.width = canvas.clientWidth * sharpness();
  canvas.height = canvas.clientHeight * sharpness();
  if (shown) { view = fitted(canvas, shown.members[part]); draw(); }
}

function zoom(factor) {
  if (!view) return;
  view.scale *= factor;
  requestAnimationFrame(draw);
}

function move(right, up) {
  if (!view) return;
  view.x += (60 * right) / view.scale;
  view.y += (60 * up) / view.scale;
  draw();
}

let held = null;
canvas.addEventListener("pointerdown", (e) => { held = { x: e.offsetX, y: e.offsetY, moved: false }; canvas.setPointerCapture(e.pointerId); });
canvas.addEventListener("pointermove", (e) => {
  if (!held || !view) return;
  const dx = e.offsetX - held.x, dy = e.offsetY - held.y;
  if (Math.abs(dx) + Math.abs(dy) > 3) held.moved = true;
  if (!held.moved) return;
  view.x -= (dx * sharpness()) / view.scale; view.y += (dy * sharpness()) / view.scale;
  held.x = e.offsetX; held.y = e.offsetY;
  requestAnimationFrame(draw);
});
canvas.addEventListener("pointerup", trying(async (e) => {
  const click = held && !held.moved;
  held = null;
  if (!click || !shown) return;
  const x = e.offsetX * sharpness(), y = e.offsetY * sharpness();
  let best = -1, nearest = (20 * sharpness()) ** 2;
  for (const i of shown.members[part] || []) {
    const d = (px(canvas, view, shown.x[i]) - x) ** 2 + (py(canvas, view, shown.y[i]) - y) ** 2;
    if (d < nearest) { nearest = d; best = i; }
  }
  if (best >= 0) await choose(best);
}));
canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(-e.deltaY / 500)); }, { passive: false });

const KEYS = {
  ArrowLeft: () => move(-1, 0), ArrowRight: () => move(1, 0), ArrowUp: () => move(0, 1), ArrowDown: () => move(0, -1),
  "+": () => zoom(1.3), "-": () => zoom(1 / 1.3), n: () => step(1), p: () => step(-1),
};
// Wherever nothing else has the focus that would take the key.
document.addEventListener("keydown", (e) => {
  const free = [canvas, document.body, document.getElementById("content")].includes(e.target);
  const act = KEYS[e.key] || KEYS[e.key.toLowerCase()];
  if (!free || !act || e.ctrlKey || e.altKey || e.metaKey) return;
  e.preventDefault();
  act();
});
document.getElementById("nearer").addEventListener("click", () => zoom(1.3));
document.getElementById("farther").addEventListener("click", () => zoom(1 / 1.3));
document.getElementById("whole").addEventListener("click", () => shown && show(part));

const loading = async () => {
  try {
    await load();
  } catch (error) {
    count.textContent = `the map cannot be shown: ${error.message}`;
  }
};
slider.addEventListener("input", () => { at.textContent = slider.value; loading(); });
colour.addEventListener("change", () => { if (shown) { drawParts(); draw(); } });
fresh.addEventListener("change", () => { if (shown) { turnToFresh(); drawParts(); draw(); } });
addEventListener("resize", resize);
resize();
loading();
