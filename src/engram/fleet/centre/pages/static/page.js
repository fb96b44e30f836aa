"use strict";
// One script for all pages: actions of buttons and forms, and the map.
const map = document.body.dataset.map;
const said = document.getElementById("said");

async function send(method, url, body, headers) {
  const answer = await fetch(url, {
    method,
    headers: { "X-Engram": "page", "Content-Type": "application/json", ...headers },
    body: body === undefined ? undefined : JSON.stringify(body),
  });
  const found = answer.status === 204 ? {} : await answer.json();
  if (!answer.ok) throw new Error(found.detail || answer.statusText);
  return found;
}

function trying(action) {
  return async (event) => {
    event.preventDefault();
    try {
      await action(event);
    } catch (error) {
      said.textContent = error.message;
    }
  };
}

for (const button of document.querySelectorAll("[data-post]"))
  button.addEventListener("click", trying(async () => {
    await send("POST", button.dataset.post);
    location.reload();
  }));

for (const form of document.querySelectorAll("[data-put]"))
  form.addEventListener("submit", trying(async () => {
    const given = Object.fromEntries(new FormData(form));
    const url = form.dataset.put.replace("{ref}", encodeURIComponent(given.ref));
    const now = await fetch(url);
    const version = now.ok ? now.headers.get("ETag") : '"0"';
    await send("PUT", url, { revision: Number(given.revision) }, { "If-Match": version });
    location.reload();
  }));

for (const form of document.querySelectorAll("[data-follows]"))
  form.addEventListener("submit", trying(async () => {
    await send("PUT", form.dataset.follows, Object.fromEntries(new FormData(form)));
    location.reload();
  }));

for (const details of document.querySelectorAll("[data-diff]"))
  details.addEventListener("toggle", trying(async () => {
    if (!details.open || details.dataset.shown) return;
    const found = await send("GET", details.dataset.diff);
    details.dataset.shown = "yes";
    const sides = (one) => `${Math.round(one.before)} → ${Math.round(one.after)}`;
    const list = document.createElement("ul");
    const lines = [`nodes ${sides(found.nodes)}: ${found.nodes.added} added, ${found.nodes.removed} removed`,
      `metres mapped ${sides(found.mapped_m)}`, `components ${sides(found.components)}`, `attempts remembered ${sides(found.attempts)}`,
      ...found.regions.map((one) => `${one.added} added, ${one.removed} removed at ${one.from_m} to ${one.to_m} m of ${one.oldest_session.slice(0, 8)}`)];
    list.append(...lines.map((line) => Object.assign(document.createElement("li"), { textContent: line })));
    details.append(list);
  }));

for (const button of document.querySelectorAll("[data-revert]"))
  button.addEventListener("click", trying(async () => {
    const revision = Number(button.dataset.revert);
    const url = `/v1/maps/${map}/reverts`;
    const would = await send("POST", url, { revision, dry_run: true });
    const lost = Object.entries(would.lost_by_others).filter(([, n]) => n > 0)
      .map(([name, n]) => `${n} ${name.replace("_", " ")}`).join(", ");
    const question = `Hide what revision ${revision} added?` + (lost ? ` Others lose ${lost}.` : "");
    if (!confirm(question)) return;
    await send("POST", url, { revision }, { "If-Match": `"${button.dataset.head}"` });
    location.reload();
  }));

const canvas = document.getElementById("canvas");
if (canvas) {
  const brush = canvas.getContext("2d");
  const [colour, slider, at, fresh] = ["colour", "slider", "at", "new"].map((id) => document.getElementById(id));
  let shown = { nodes: [], sessions: [] };
  let view = null; // metres at the middle, and pixels a metre
  let chosen = -1;
  let asked = 0;
  let fitted = false;

  const hue = (n, of) => `hsl(${Math.round((360 * n * 0.618) % 360)} 65% ${of > 8 ? 38 + (n % 3) * 9 : 42}%)`;
  const KEYS = {
    session: (n) => { const s = shown.sessions[n[3]]; return `${s.robot}, ${s.id.slice(0, 8)}`; },
    robot: (n) => shown.sessions[n[3]].robot,
    revision: (n) => `revision ${n[4]}`,
    hour: (n) => (n[5] === null ? "hour unknown" : `${String(Math.floor(n[5])).padStart(2, "0")} h`),
  };

  function visible() {
    return fresh.checked ? shown.nodes.filter((n) => n[4] === shown.revision) : shown.nodes;
  }

  function fit() {
    const some = shown.nodes;
    if (!some.length) { view = { x: 0, y: 0, scale: 1 }; return; }
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const n of some) { x0 = Math.min(x0, n[1]); x1 = Math.max(x1, n[1]); y0 = Math.min(y0, n[2]); y1 = Math.max(y1, n[2]); }
    const scale = 0.92 * Math.min(canvas.width / Math.max(x1 - x0, 5), canvas.height / Math.max(y1 - y0, 5));
    view = { x: (x0 + x1) / 2, y: (y0 + y1) / 2, scale };
  }

  const px = (n) => canvas.width / 2 + (n[1] - view.x) * view.scale;
  const py = (n) => canvas.height / 2 - (n[2] - view.y) * view.scale;

  function draw() {
    const some = visible(), key = KEYS[colour.value], groups = new Map();
    for (const n of some) {
      const name = key(n);
      if (!groups.has(name)) groups.set(name, []);
      groups.get(name).push(n);
    }
    brush.fillStyle = "#fff";
    brush.fillRect(0, 0, canvas.width, canvas.height);
    const size = Math.max(3, Math.min(9, view.scale * 0.8)) * devicePixelRatio;
    const names = [...groups.keys()].sort();
    names.forEach((name, i) => {
      brush.fillStyle = hue(i, names.length);
      for (const n of groups.get(name)) brush.fillRect(px(n) - size / 2, py(n) - size / 2, size, size);
    });
    if (chosen >= 0 && shown.nodes[chosen]) {
      brush.strokeStyle = "#000"; brush.lineWidth = 2 * devicePixelRatio;
      brush.beginPath();
      brush.arc(px(shown.nodes[chosen]), py(shown.nodes[chosen]), size * 1.6, 0, 7);
      brush.stroke();
    }
    scaleBar();
    document.getElementById("count").textContent = `${some.length} nodes`;
    const legend = document.getElementById("legend");
    legend.replaceChildren(...names.slice(0, 24).map((name, i) => {
      const item = document.createElement("li"), dot = document.createElement("i");
      dot.style.background = hue(i, names.length);
      item.append(dot, `${name} (${groups.get(name).length})`);
      return item;
    }));
  }

  function scaleBar() {
    const metres = 10 ** Math.floor(Math.log10((canvas.width * 0.3) / view.scale));
    const long = metres * view.scale, y = canvas.height - 14 * devicePixelRatio;
    brush.fillStyle = "#1b2733";
    brush.fillRect(12, y, long, 3);
    brush.font = `${13 * devicePixelRatio}px system-ui`;
    brush.fillText(`${metres} m`, 12, y - 6);
  }

  async function choose(i) {
    chosen = i;
    draw();
    const node = shown.nodes[i], card = document.getElementById("card");
    const found = await (await fetch(`/v1/maps/${map}/blame/${node[0]}`)).json();
    const list = document.createElement("dl");
    const dated = /^\d{4}-/.test(found.when); // a robot without a date counts from its start
    const facts = { node: found.node, robot: found.robot, when: dated ? `${found.when.slice(0, 19).replace("T", " ")} UTC` : found.when, "driven": `${Number(found.driven_m).toFixed(1)} m`,
      "added by": `revision ${found.revision}`, matched: `${found.matches} of ${found.attempts}`, paths: found.paths };
    for (const [name, value] of Object.entries(facts)) {
      const term = document.createElement("dt"), fact = document.createElement("dd");
      term.textContent = name; fact.textContent = value; list.append(term, fact);
    }
    const image = new Image();
    image.alt = `What ${found.robot} saw here`;
    image.src = `/maps/${map}/nodes/${node[0]}/picture`;
    image.onerror = () => image.remove();
    card.replaceChildren(image, list);
  }

  async function load() {
    const mine = ++asked;
    const answer = await fetch(`/maps/${map}/nodes?at=${slider.value}`);
    const found = await answer.json();
    if (mine !== asked || !answer.ok) return;
    shown = found;
    chosen = -1;
    if (!fitted && shown.nodes.length) { fit(); fitted = true; }
    draw();
  }

  function resize() {
    canvas.width = canvas.clientWidth * devicePixelRatio;
    canvas.height = canvas.clientHeight * devicePixelRatio;
    fit();
    draw();
  }

  let held = null;
  canvas.addEventListener("pointerdown", (e) => { held = { x: e.offsetX, y: e.offsetY, moved: false }; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", (e) => {
    if (!held) return;
    const dx = e.offsetX - held.x, dy = e.offsetY - held.y;
    if (Math.abs(dx) + Math.abs(dy) > 3) held.moved = true;
    if (!held.moved) return;
    view.x -= (dx * devicePixelRatio) / view.scale; view.y += (dy * devicePixelRatio) / view.scale;
    held.x = e.offsetX; held.y = e.offsetY;
    requestAnimationFrame(draw);
  });
  canvas.addEventListener("pointerup", (e) => {
    const click = held && !held.moved;
    held = null;
    if (!click || !shown.nodes.length) return;
    const x = e.offsetX * devicePixelRatio, y = e.offsetY * devicePixelRatio;
    let best = -1, nearest = (20 * devicePixelRatio) ** 2;
    shown.nodes.forEach((n, i) => {
      const d = (px(n) - x) ** 2 + (py(n) - y) ** 2;
      if (d < nearest) { nearest = d; best = i; }
    });
    if (best >= 0) choose(best);
  });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); view.scale *= Math.exp(-e.deltaY / 500); requestAnimationFrame(draw); }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const step = 60 / view.scale;
    const keys = { ArrowLeft: () => (view.x -= step), ArrowRight: () => (view.x += step), ArrowUp: () => (view.y += step), ArrowDown: () => (view.y -= step),
      "+": () => (view.scale *= 1.3), "-": () => (view.scale /= 1.3), n: () => shown.nodes.length && choose((chosen + 1) % shown.nodes.length) };
    const act = keys[e.key] || keys[e.key.toLowerCase()];
    if (act) { e.preventDefault(); act(); draw(); }
  });
  slider.addEventListener("input", () => { at.textContent = slider.value; load(); });
  colour.addEventListener("change", draw);
  fresh.addEventListener("change", draw);
  addEventListener("resize", resize);
  resize();
  load();
}
