"use strict";
// For all pages: actions of buttons and forms, and local times.
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

// Times in the reader's own time zone; the title keeps UTC.
function localise(time) {
  const then = new Date(time.dateTime);
  time.textContent = then.toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" });
  return time;
}

function timeOf(stamp) {
  const title = `${stamp.slice(0, 16).replace("T", " ")} UTC`;
  return localise(Object.assign(document.createElement("time"), { dateTime: stamp, title }));
}

document.querySelectorAll("time").forEach(localise);

// The small picture of a node; some have none.
function pictureOf(node, alt) {
  const image = Object.assign(new Image(), { alt, src: `/maps/${map}/nodes/${node}/picture` });
  image.onerror = () => image.remove();
  return image;
}

for (const details of document.querySelectorAll("[data-changes]"))
  details.addEventListener("toggle", trying(async () => {
    if (!details.open || details.dataset.shown) return;
    details.dataset.shown = "yes";
    const found = await send("GET", details.dataset.changes);
    const list = document.createElement("ul"), pictures = document.createElement("p");
    list.append(...found.lines.map((line) => Object.assign(document.createElement("li"), { textContent: line })));
    pictures.append(...found.nodes.map((node) => pictureOf(node, `Seen at node ${node.slice(0, 8)}, which it added`)));
    details.append(list, pictures);
  }));

const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

function questionOf(button, would) {
  const { revert, by, nodes } = button.dataset;
  const lines = [`Hide what revision ${revert} added: ${counted(Number(nodes), "node")} of ${by}?`,
    `The map then has ${counted(would.nodes.after, "node")} instead of ${would.nodes.before}` +
    (would.components.after > would.components.before ? `, and falls into ${would.components.after} parts instead of ${would.components.before}.` : ".")];
  const lost = Object.entries(would.lost_by_others).filter(([, n]) => n > 0)
    .map(([name, n]) => `${n} ${name.replace("_", " ")}`).join(", ");
  if (lost) lines.push(`What later revisions built on it goes with it: ${lost}.`);
  lines.push("Nothing is erased: reverting the new revision shows it again.");
  return lines.join("\n");
}

for (const button of document.querySelectorAll("[data-revert]"))
  button.addEventListener("click", trying(async () => {
    const revision = Number(button.dataset.revert);
    const url = `/v1/maps/${map}/reverts`;
    const would = await send("POST", url, { revision, dry_run: true });
    if (!confirm(questionOf(button, would))) return;
    await send("POST", url, { revision }, { "If-Match": `"${button.dataset.head}"` });
    location.reload();
  }));

for (const button of document.querySelectorAll("[data-delete]"))
  button.addEventListener("click", trying(async () => {
    if (!confirm(button.dataset.question)) return;
    await send("DELETE", button.dataset.delete);
    location.reload();
  }));

for (const form of document.querySelectorAll("[data-code]"))
  form.addEventListener("submit", trying(async () => {
    const { robot, follows } = Object.fromEntries(new FormData(form));
    const { code } = await send("POST", form.dataset.code, { follows });
    const shown = document.getElementById("code");
    shown.querySelector("code").textContent = `engram agent enrol robots/${robot} ${location.origin} ${code} --robot ${robot}`;
    shown.hidden = false;
  }));
