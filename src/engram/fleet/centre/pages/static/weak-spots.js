"use strict";
// The layer of weak spots: where and at which hours the next drives will probably not be localised.
const [weakSwitch, weakPanel, weakState, weakAdvice, weakList, weakMore] = [
  "weak", "weak-panel", "weak-state", "weak-advice", "weak-list", "weak-more",
].map((id) => document.getElementById(id));
const SPOT = "#d55e00"; // as the report draws what is missed most
const ADVISED = "#0b62a8";
// A spot on the map is so wide, pixels, and so much wider if all of it is missed.
const [NARROW, WIDER] = [8, 16];
// The least that the map shows around a spot, metres.
const AROUND_M = 30;

let weak = null; // what the server sent of a revision; null until it did
let weakAsking = false;
let stretch = null; // the chosen spot, or the advice

// The layer of the revision that is shown; null while it is off or on its way.
const weakHere = () => (weakSwitch.checked && weak && shown && weak.revision === shown.revision ? weak : null);

async function loadWeak() {
  weakPanel.hidden = !weakSwitch.checked;
  if (!weakSwitch.checked || weakHere()) { drawWeak(); return; }
  weakAdvice.hidden = weakList.hidden = weakMore.hidden = true;
  weakState.textContent = "loading…";
  // One request at a time, however fast the slider moves: the newest revision comes last.
  if (weakAsking) return;
  const revision = slider.value;
  weakAsking = true;
  try {
    weak = await send("GET", `/maps/${map}/weak-spots?at=${revision}`);
    stretch = null;
  } catch (error) {
    weak = null;
    if (slider.value === revision) weakState.textContent = `weak spots cannot be shown: ${error.message}`;
  } finally {
    weakAsking = false;
  }
  if (slider.value !== revision) await loadWeak();
  else drawWeak();
}

// The list, and the map anew.
function drawWeak() {
  const found = weakHere();
  weakAdvice.hidden = weakList.hidden = weakMore.hidden = !found;
  if (found) {
    const said = [found.verdict, found.unknown_hours].filter(Boolean);
    weakState.textContent = said.map((text) => `${text[0].toUpperCase()}${text.slice(1)}.`).join(" ");
    weakAdvice.hidden = !found.advice;
    if (found.advice) weakAdvice.replaceChildren(stretchButton(found.advice, [found.advice.text]));
    weakList.replaceChildren(...found.spots.map(spotItem));
    weakMore.hidden = !found.more;
    weakMore.textContent = `and ${found.more} with less missed`;
  }
  if (shown) { drawParts(); draw(); }
}

function spotItem(spot) {
  const hours = spot.hours.replace(" h", "\u00a0h"), [missed, length] = [spot.share * spot.length_m, spot.length_m].map(Math.round);
  const reason = `${spot.why}; ${spot["like drives"]} past drives in such light; ${spot["of all missed"]} of all missed`;
  const item = document.createElement("li");
  item.append(stretchButton(spot, [`${missed} of ${length} m missed, ${hours}`, `${spot.along}, ${spot.metres} m into the drive`, reason]));
  return item;
}

// A button that zooms to a stretch; its first line stands out.
function stretchButton(one, lines) {
  const button = document.createElement("button");
  const [first, ...rest] = lines.map((text, k) => Object.assign(document.createElement(k ? "span" : "b"), { textContent: text }));
  button.append(first, ...rest);
  button.setAttribute("aria-pressed", String(one === stretch));
  button.addEventListener("click", () => chooseStretch(one, button));
  return button;
}

function chooseStretch(one, button) {
  stretch = one;
  for (const other of weakPanel.querySelectorAll("button")) other.setAttribute("aria-pressed", String(other === button));
  if (!one.nodes.length) return;
  show(shown.part[one.nodes[0]]);
  view = fitted(canvas, one.nodes, AROUND_M);
  draw();
  canvas.scrollIntoView({ block: "nearest" });
}

// Under the nodes: a band for each spot, wider the more of it is missed, with its number in the list.
function paintWeak(sheet, eye, number) {
  const found = weakHere();
  if (!found) return;
  const here = (one) => one.nodes.length && shown.part[one.nodes[0]] === number;
  const brush = sheet.getContext("2d");
  brush.lineCap = brush.lineJoin = "round";
  for (const spot of found.spots) if (here(spot) && spot !== stretch) band(brush, sheet, eye, spot, SPOT);
  if (stretch && here(stretch)) band(brush, sheet, eye, stretch, stretch === found.advice ? ADVISED : SPOT);
  brush.lineCap = "butt"; brush.lineJoin = "miter";
}

function band(brush, sheet, eye, one, ink) {
  const nodes = new Set(one.nodes), path = new Path2D();
  for (const i of one.nodes) {
    const x = px(sheet, eye, shown.x[i]), y = py(sheet, eye, shown.y[i]), from = shown.before[i];
    if (nodes.has(from)) path.moveTo(px(sheet, eye, shown.x[from]), py(sheet, eye, shown.y[from]));
    else path.moveTo(x, y);
    path.lineTo(x, y);
  }
  const width = (NARROW + WIDER * (one.share || 0)) * sharpness();
  const layers = one === stretch ? [[INK, 4], ["#fff", 0], [`${ink}80`, 0]] : [[`${ink}50`, 0]];
  for (const [colour, more] of layers) {
    brush.strokeStyle = colour;
    brush.lineWidth = width + more * sharpness();
    brush.stroke(path);
  }
}

// Over the nodes: the numbers of the spots, those of one place together.
function numberWeak(sheet, eye, number) {
  const found = weakHere(), flags = [], apart = 24 * sharpness();
  if (!found) return;
  found.spots.forEach((spot, k) => {
    const middle = spot.nodes[Math.floor(spot.nodes.length / 2)];
    if (middle === undefined || shown.part[middle] !== number) return;
    const x = px(sheet, eye, shown.x[middle]), y = py(sheet, eye, shown.y[middle]);
    const near = flags.find((flag) => Math.hypot(flag.x - x, flag.y - y) < apart);
    if (near) near.numbers.push(k + 1);
    else flags.push({ x, y, numbers: [k + 1] });
  });
  const brush = sheet.getContext("2d"), size = 13 * sharpness();
  brush.font = `600 ${size}px system-ui`;
  for (const { x, y, numbers } of flags) {
    const text = numbers.length > 3 ? `${numbers.slice(0, 3).join(", ")} …` : numbers.join(", ");
    const width = brush.measureText(text).width + size, top = y - 2.4 * size;
    brush.fillStyle = INK;
    brush.fillRect(x - width / 2, top, width, 1.5 * size);
    brush.fillStyle = "#fff";
    brush.fillText(text, x - width / 2 + size / 2, top + 1.1 * size);
  }
}

weakSwitch.addEventListener("change", loadWeak);
