// The page of a session: it shows what the command sends, and sends what people ask. Text is set as text, never as HTML.
const $ = (selector, within = document) => within.querySelector(selector);
const keys = { t: "take", w: "when_still", u: "undo", s: "save", q: "stop" };
const wheres = { use: "good", care: "care", do_not_use: "bad" };
const views = new Map();
let socket, hasEnded = false, state = null, heldUntil = 0;

function made(tag, text = "", kind = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  if (kind) element.className = kind;
  return element;
}

function fill(element, children) {
  // Lists that are read aloud or selected stay as they are where nothing changed.
  const key = children.map((child) => child.outerHTML).join("");
  if (element.shown !== key) { element.shown = key; element.replaceChildren(...children); }
}

const digits = (value) => (value === null ? "not determined" : value >= 100 ? value.toFixed(0) : value.toPrecision(2));

function viewOf(name) {
  if (!views.has(name)) {
    const figure = made("figure"), view = made("div", "", "view"), canvas = made("canvas"), caption = made("figcaption");
    const words = made("div"), cells = made("div", "", "cells");
    canvas.setAttribute("role", "img");
    cells.setAttribute("role", "img");
    words.append(made("b", name), made("div", "no image yet", "sees"), made("div", "", "dim counts"));
    view.append(canvas); caption.append(words, cells); figure.append(view, caption);
    $("#cameras").append(figure);
    views.set(name, { figure, canvas, words, cells, head: null, image: null });
  }
  return views.get(name);
}

function draw(name) {
  const { canvas, head, image, figure, words } = viewOf(name);
  const [width, height] = head.size ?? (image ? [image.width, image.height] : [640, 480]);
  canvas.width = width; canvas.height = height;
  const pen = canvas.getContext("2d"), unit = width / 640;
  if (image) pen.drawImage(image, 0, 0, width, height);
  const path = (points) => {
    pen.beginPath();
    points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.closePath();
  };
  const label = (text, x, y) => {
    pen.font = `600 ${15 * unit}px system-ui, sans-serif`;
    const room = pen.measureText(text).width + 8 * unit;
    x = Math.max(0, Math.min(x, width - room)); y = Math.max(20 * unit, y);
    pen.fillStyle = "#000b"; pen.fillRect(x, y - 19 * unit, room, 20 * unit);
    pen.fillStyle = "#fff"; pen.fillText(text, x + 4 * unit, y - 4 * unit);
  };
  for (const { name: target, reason, corners, is_tag } of head.targets) {
    if (!corners.length) continue;
    const colour = reason ? "#d55e00" : "#56b4e9";
    for (const [line, paint] of [[5, "#000"], [2.5, colour]]) {
      pen.lineWidth = line * unit; pen.strokeStyle = paint; pen.setLineDash(reason ? [6 * unit, 5 * unit] : []);
      if (is_tag) { path(corners); pen.stroke(); }
      else for (const [x, y] of corners) { pen.beginPath(); pen.arc(x, y, 3 * unit, 0, 7); pen.stroke(); }
    }
    label(reason ? `${target}: ${reason}` : target, Math.min(...corners.map((c) => c[0])), Math.min(...corners.map((c) => c[1])));
  }
  pen.setLineDash([12 * unit, 8 * unit]);
  for (const outline of state?.answer?.proposal?.outlines[name] ?? []) {
    for (const [line, paint] of [[7, "#000"], [4, "#f0e442"]]) {
      pen.lineWidth = line * unit; pen.strokeStyle = paint; path(outline); pen.stroke();
    }
    label("bring it here", outline[0][0], outline[0][1]);
  }
  pen.setLineDash([]);
  const seen = head.targets.map((each) => (each.reason ? `${each.name} (${each.reason})` : each.name)).join(", ");
  $(".sees", words).textContent = `sees ${seen || "no target"}`;
  canvas.setAttribute("aria-label", `Image of ${name}: ${seen || "no target"}`);
  figure.dataset.age = Math.round(Date.now() - head.seen_ms);
  figure.dataset.late = Math.round(Date.now() - head.received_ms);
  figure.dataset.drawn = Number(figure.dataset.drawn ?? 0) + 1;
}

async function showPicture(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const view = viewOf(head.sensor), picture = new Blob([new Uint8Array(buffer, 4 + length)]);
  const image = picture.size ? await createImageBitmap(picture).catch(() => null) : null;
  view.image?.close();
  view.head = head; view.image = image;
  draw(head.sensor);
  socket.send(JSON.stringify({ drawn: head.sensor }));
}

function showCamera(camera, answer) {
  const { words, cells } = viewOf(camera.name);
  if (camera.fault || camera.is_quiet) $(".sees", words).textContent = camera.fault || "no images now";
  $(".counts", words).textContent = `${camera.received} came, ${camera.looked} searched, ${camera.skipped} passed over for newer ones`;
  const grid = answer?.cells[camera.name] ?? [];
  cells.hidden = !grid.length;
  if (!grid.length) return;
  cells.style.gridTemplateColumns = `repeat(${grid[0].length}, 1fr)`;
  fill(cells, grid.flat().map((count) => made("i", "", count ? "has" : "")));
  const share = Math.round((100 * grid.flat().filter(Boolean).length) / grid.flat().length);
  cells.setAttribute("aria-label", cells.title = `${share} % of the image has corners of takes`);
}

function showAnswer({ answer, verdict, wanted, takes, is_answering }) {
  const section = $("#verdict");
  section.className = answer ? wheres[answer.verdict] ?? "" : "";
  $(".word", section).textContent = answer ? verdict || "No answer yet" : takes.count ? "Calibrating" : "Nothing taken yet";
  $(".why", section).textContent = answer ? answer.reason || answer.why_none : "";
  $(".age", section).textContent = answer
    ? `From ${answer.takes} take${answer.takes === 1 ? "" : "s"}, in ${answer.seconds.toFixed(1)} s${is_answering ? "; calibrating the newer ones" : ""}.`
    : "";
  const decision = answer?.decision;
  const wanted_mm = wanted ? Number((1e3 * wanted.radius_m).toPrecision(4)) : null;
  $("#accuracy .wanted").textContent = [
    wanted ? `Wanted: a point ${wanted.distance_m} m away within ${wanted_mm} mm, with ${Math.round(100 * wanted.level)} %.` : "",
    decision ? decision.words : "",
    decision?.takes_needed ? `About ${decision.takes_needed} more takes.` : "",
  ].join(" ");
  fill($("#accuracy .points"), (answer?.points ?? []).map((point) => {
    const is_reached = wanted && point.radius_mm !== null && point.radius_mm <= wanted_mm;
    const item = made("li", "", is_reached ? "reached" : "");
    const off = point.radius_mm === null ? digits(null) : `within ${digits(point.radius_mm)} mm`;
    item.append(made("div", `${point.sensor}, ${point.distance_m.toFixed(2)} m away: ${off}${is_reached ? " ✓" : ""}`));
    if (wanted) {
      const bar = made("div", "", "bar"), inside = made("i");
      inside.style.width = `${point.radius_mm ? Math.min(100, (100 * wanted_mm) / point.radius_mm) : 0}%`;
      bar.append(inside); item.append(bar);
    }
    return item;
  }));
  const pairs = answer?.pairs ?? [], sensors = [...new Set(pairs.map((pair) => pair.sensor))];
  const head = made("tr"), first = made("th", "target");
  head.append(first, ...sensors.map((name) => made("th", name)));
  for (const each of head.children) each.scope = "col";
  const top = made("thead"); top.append(head);
  fill($("#determines table"), pairs.length ? [top, ...[...new Set(pairs.map((pair) => pair.target))].map((target) => {
    const row = made("tr"), name = made("th", target);
    name.scope = "row";
    row.append(name, ...sensors.map((sensor) => {
      const { count, is_determined } = pairs.find((pair) => pair.target === target && pair.sensor === sensor);
      return made("td", count ? `${is_determined ? "■" : "□"} ${count}` : "·");
    }));
    return row;
  })] : []);
  fill($("#determines .free"), (answer?.free ?? []).map((words) => made("li", words)));
  $("#next").hidden = !answer?.proposal;
  if (answer?.proposal) {
    const place = answer.proposal.T.slice(0, 3).map((row) => row[3].toFixed(3)).join(", ");
    $("#next .words").textContent = answer.proposal.words;
    $("#next .pose").textContent = `At ${place} m in ${answer.proposal.frame}`;
  }
}

function show(now) {
  state = now;
  hasEnded = now.ended;
  const chip = (id, text, kind) => { $(id).textContent = text; $(id).className = `chip ${kind}`; };
  chip("#source", `${now.source.name}: ${now.source.state}`, now.source.is_connected ? "" : "bad");
  chip("#still", now.still.is_still ? "■ stands still" : `□ ${now.still.words}`, now.still.is_still ? "good" : "");
  chip("#count", `${now.takes.count} take${now.takes.count === 1 ? "" : "s"}${now.takes.count && now.takes.is_saved ? ", saved" : ""}`, "");
  now.cameras.forEach((camera, place) => {
    showCamera(camera, now.answer);
    viewOf(camera.name).figure.style.order = place;
  });
  showAnswer(now);
  fill($("#happened .troubles"), now.troubles.map((words) => made("li", words, "bad")));
  fill($("#happened .said"), now.said.map(([time, kind, words]) => {
    const item = made("li", "", kind);
    item.append(made("time", time), `${{ good: "✓ ", bad: "✗ " }[kind] ?? ""}${words}`);
    return item;
  }));
  fill($("#happened .counted"), now.counted.map((words) => made("li", words)));
  $("#happened .folder").textContent = `Everything is in ${now.folder}`;
  for (const button of document.querySelectorAll("button")) button.disabled = now.ended;
  $("#pose").hidden = !now.source.takes_poses;
  $("[data-do=take]").setAttribute("aria-busy", now.takes.pending);
  $("[data-do=when_still]").setAttribute("aria-pressed", now.takes.when_still);
  $("[data-do=undo]").disabled ||= !now.takes.count;
  if (Date.now() > heldUntil) banner(now.ended ? "The session has ended. What it wrote is named below." : now.busy);
}

function banner(words) {
  $("#banner").hidden = !words;
  if ($("#banner").textContent !== words) $("#banner").textContent = words;
}

$("#pose").addEventListener("submit", (event) => {
  event.preventDefault();
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ take_at: $("#typed").value }));
  $("#typed").select();
});

function ask(name) {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ do: name }));
}

function connect() {
  socket = new WebSocket(`ws://${location.host}${location.pathname}socket`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => {
    if (typeof data !== "string") { showPicture(data); return; }
    const said = JSON.parse(data);
    if (said.error) { heldUntil = Date.now() + 4000; banner(said.error); } else show(said);
  };
  socket.onclose = () => {
    if (hasEnded) return;
    banner("No connection to the command gtsam-rwhec live; trying again. Does it still run?");
    setTimeout(connect, 1000);
  };
}

document.addEventListener("click", ({ target }) => {
  const button = target.closest("button");
  if (button?.dataset.do) ask(button.dataset.do);
});
document.addEventListener("keydown", (event) => {
  if (event.target.matches("input") || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
  const name = keys[event.key.toLowerCase()];
  if (name && !hasEnded) ask(name);
});
connect();
