"use strict";
// The page of one robot. Text of the robot only ever becomes textContent, never markup.

const BEAT_MS = 100, SILENT_MS = 1000, POST_MS = 300, GIVE_UP_MS = 4000, ANSWER_MS = 8000, PICTURE_HZ = 15, EVENTS = 200;
const $ = (id) => document.getElementById(id);
const AXES = ["x", "y", "z", "rx", "ry", "rz"];
const NONE = [0, 0, 0, 0, 0, 0];

let token = "", control = null, pictures = null;
let state = {}, welcome = { drives: false }, heardMs = 0, tick = 0;
let press = Math.floor(Math.random() * 1e6), holding = 0, beatTimer = 0, twist = NONE, opening = 0;
let stopping = 0, stopTimer = 0;

function el(tag, text, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  if (text !== null && text !== undefined) made.textContent = text;
  made.append(...children);
  return made;
}
const seconds = (value) => (value === null || value === undefined ? "?" : `${value.toFixed(2)} s`);
const clock = (ms) => new Date(ms).toLocaleTimeString([], { hour12: false, hour: "2-digit", minute: "2-digit", second: "2-digit" });
function setText(node, text) { if (node.textContent !== text) node.textContent = text; }

// -- connection ---------------------------------------------------------------------------
function socketTo(path) {
  return new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`);
}

function connect() {
  const socket = (control = socketTo("/control"));
  socket.onopen = () => socket.send(JSON.stringify({ do: "enter", token }));
  socket.onmessage = (event) => { heardMs = performance.now(); receive(JSON.parse(event.data)); };
  socket.onclose = (event) => {
    if (control !== socket) return;
    control = null;
    endHold();
    showLink();
    if (event.code !== 1008) setTimeout(connect, 1000);
  };
}

function send(message) {
  if (!control || control.readyState !== WebSocket.OPEN) return false;
  control.send(JSON.stringify(message));
  return true;
}

const DONE = { hold: "active while you hold", activate: "active", prompt: "prompt set", worker: "model chosen", rate: "rate set", speed: "speed set", jog: "done" };
const RECEIVE = {
  state: showState,
  nodes: showNodes,
  event: showEvent,
  welcome: enter,
  denied: (message) => askToken(message.why),
  done: (message) => { if (message.what === "primitive" && message.press === press) endHold(); answer(message.what === "guide" ? "" : message.text || DONE[message.what] || "done", [], "good"); },
  failed: (message) => { if (message.press === press) endHold(); answer(message.why, message.reasons, "bad"); },
  rejected: (message) => answer(`${message.what}: ${message.why}`, [], "bad"),
  hold_ended: (message) => { if (message.press === press) endHold(message.why || "the hold ended: press again"); },
  stopped: showStopped,
  recording: showRecording,
  invited: showInvited,
};
function receive(message) { (RECEIVE[message.is] || (() => {}))(message); }

function askToken(why) {
  sessionStorage.removeItem("token");
  if (why) $("enter-why").textContent = `Not accepted: ${why}. The token is in the line that vla-zenoh web printed, or in its file of people.`;
  if (!$("enter").open) $("enter").showModal();
}
$("enter").addEventListener("cancel", (event) => event.preventDefault());
$("enter-form").addEventListener("submit", () => { useToken($("token").value.trim()); $("token").value = ""; });

function useToken(given) {
  token = given;
  sessionStorage.setItem("token", token);
  connect();
}

function enter(message) {
  welcome = message;
  document.title = `${message.robot} - vla-zenoh`;
  $("robot").textContent = message.robot;
  $("who").replaceChildren(message.person, el("span", message.drives ? ", operator" : ", viewer", { className: "role" }));
  for (const node of document.querySelectorAll(".drives")) node.disabled = !message.drives;
  for (const node of document.querySelectorAll(".operator")) node.hidden = !message.drives;
  $("stop").disabled = !message.drives;
  $("look").hidden = !message.drives;
  if (!message.drives) $("hold-help").textContent = "A viewer may look. Stop at the robot, or ask an operator.";
  $("reset").hidden = true;
  warn(message.insecure ? "Insecure profile: anyone on the network can command this robot." : "");
  $("arm-words").textContent = message.no_arm;
  $("keep-out-legend").hidden = Object.values(message.surroundings).every((part) => !Object.keys(part.keep_out).length);
  const parts = Object.keys(message.surroundings);
  options($("part"), parts, parts.includes($("part").value) ? $("part").value : parts[0]);
  $("which-arm").hidden = parts.length < 2;
  $("events").replaceChildren();
  levels(message.levels || []);
  handSeen = "";
  $("held").replaceChildren(...parts.map(heldField));
  if (message.drives) watchPictures();
}

function heldField(part) { // the box that a gripper holds
  const input = el("input", "", { maxLength: 100, placeholder: "0.04 0.04 0.12", autocomplete: "off" });
  input.addEventListener("change", () => { send({ do: "held", part, text: input.value.trim() }); input.blur(); });
  const label = el("label", `The ${part} gripper holds a box of X Y Z m, along the tool (empty: nothing) `.replace("  ", " "));
  label.append(input);
  return label;
}

function warn(text) { $("warning").hidden = !text; setText($("warning"), text); }

function showLink() {
  const silent = performance.now() - heardMs > SILENT_MS || !control || !state.is;
  const late = !silent && state.silent_s > 2;
  setText($("link"), silent ? "NOT CONNECTED" : late ? "robot silent" : "connected");
  $("link").className = `badge ${silent || late ? "bad" : "good"}`;
  if (silent) {
    setText($("stop-words"), "Not connected: this page stops nothing. Use the robot's own emergency stop.");
    showBanner({ level: "bad", what: "This page has no connection to the robot.", do: "It connects again by itself. A hold has ended." });
  } else if ($("stop-words").textContent.startsWith("Not connected")) setText($("stop-words"), "");
}
setInterval(showLink, 250);

// -- state --------------------------------------------------------------------------------
const GOOD = ["active", "inferring", "running", "routing", "ok"], BAD = ["stopped", "fault", "dead", "missing", "crashed", "unreadable"];
const level = (word) => (GOOD.includes(word) ? "good" : BAD.includes(word) ? "bad" : "warn");
const MODES = { sim: "SIM", dry_run: "DRY RUN", live: "LIVE", unknown: "MODE UNKNOWN" };

function showBanner(banner) {
  $("banner").className = banner.level;
  setText($("what"), banner.what);
  setText($("do"), banner.do);
}
function showState(message) {
  state = message;
  tick = message.tick;
  setText($("mode"), MODES[message.mode] || message.mode);
  $("mode").className = `badge ${message.mode === "live" ? "bad" : "quiet"}`;
  setText($("state"), message.state);
  $("state").className = `badge ${level(message.state)}`;
  const guided = message.guide.step !== "done" && message.state === "inactive" && message.guide.text;
  const next = message.you_hold && message.state === "active" ? "Let go to brake." : guided || message.banner.do;
  showBanner({ ...message.banner, do: next });
  $("reset").hidden = !welcome.drives || !["stopped", "fault"].includes(message.state);
  const task = message.task;
  if (task) {
    if (!promptTyped) setUnlessFocused("prompt", task.prompt);
    setUnlessFocused("rate", String(task.rate_hz));
    if (document.activeElement !== $("speed")) { $("speed").value = task.speed_percent; setText($("speed-now"), `${task.speed_percent} %`); }
    options($("worker"), [...new Set([...message.workers, task.worker])], task.worker);
  }
  const arms = Object.entries(message.arms || {}), fastest = Math.max(0, ...arms.map(([, arm]) => arm.speed_m_s || 0));
  facts([
    ["why", message.why.replace(/'web-(.+?)-[0-9a-f]+'/g, "$1")],
    ["held by", message.you_hold ? "you" : message.holder ? message.holder : task && task.active ? "nobody: it runs without a hold" : "nobody"],
    ["arm", `${message.at_rest === null ? "unknown" : message.at_rest ? "stands" : "moves"}, ${(fastest * 100).toFixed(1)} cm/s`],
    ...arms.map(([name, arm]) => [`gripper ${name}`.trim(), arm.width_m === undefined ? "" : arm.width_m === null ? "none" : `${(arm.width_m * 1000).toFixed(0)} mm${arm.holding ? ", holds an object" : ""}${arm.holds ? `, counted as a box of ${arm.holds} m` : ""}`]),
    ["limits", message.limits.join("; ")],
  ]);
  showPeople(message.people);
  showGuide(message.guide, message.mode);
  keepTrend(message, fastest);
  const byHand = JSON.stringify(message.hand);
  if (message.jog && byHand !== handSeen) {
    handSeen = byHand;
    for (const [id, value] of Object.entries(message.hand)) $(id).value = value;
  }
  $("take").setAttribute("aria-pressed", String(message.jog === true));
  setText($("take"), message.jog ? "Hand back" : "Take the arm");
  const grips = typeof (message.arms?.[$("part").value] || {}).width_m === "number";
  for (const button of $("pad").children) button.disabled = !message.jog || (button.dataset.gripper && !grips);
  for (const button of $("primitives").children) button.disabled = !message.primitives || (button.dataset.gripper && !grips);
  setText($("primitives-words"), message.primitives ? "They move while the button is pressed, from an arm that stands." : "They need the node primitives: `vla-zenoh node primitives`.");
  $("save").disabled = !message.rolling || !welcome.drives;
  streams(message.seen || []);
  drawArms(message.arms || {});
  if (stopping && message.state === "stopped") setText($("stop-words"), `${welcome.robot}: stopped, coming to rest`);
  else if (message.state === "stopped" && !$("stop-words").textContent) setText($("stop-words"), `${welcome.robot} is stopped: ${message.why}`);
}

function showPeople(people) {
  const lines = people.map((one) => `${one.name}, ${one.role}${one.pages > 1 ? `, ${one.pages} pages` : ""}${one.holds ? ": holds the arm" : ""}`);
  if ([...$("here").children].map((line) => line.textContent).join("\n") !== lines.join("\n"))
    $("here").replaceChildren(...lines.map((line) => el("li", line)));
}
$("invite").addEventListener("submit", (event) => {
  event.preventDefault();
  send({ do: "invite", name: $("invite-name").value.trim(), role: $("invite-role").value });
});
function showInvited(message) {
  const link = `${location.origin}/#${message.token}`;
  $("invite-name").value = "";
  $("invited-link").hidden = false;
  $("invited-link").value = link;
  $("invited-link").select();
  setText($("invited-words"), `The link below is ${message.name}'s alone, until this server ends.`);
  if (navigator.clipboard) navigator.clipboard.writeText(link).then(() => setText($("invited-words"), `${$("invited-words").textContent} It is copied.`), () => {});
}
$("leave").addEventListener("click", () => {
  endHold();
  for (const socket of [control, pictures]) if (socket) { socket.onclose = null; socket.close(); }
  control = pictures = null;
  token = "";
  for (const node of document.querySelectorAll(".drives")) node.disabled = true;
  $("stop").disabled = true;
  welcome = { drives: false };
  setText($("who"), "");
  askToken("");
});

function setUnlessFocused(id, value) { if (document.activeElement !== $(id) && $(id).value !== value) $(id).value = value; }

function options(select, names, chosen) {
  if (document.activeElement === select) return;
  if ([...select.options].map((one) => one.value).join() !== names.join())
    select.replaceChildren(...names.map((name) => el("option", name, { value: name })));
  if (select.value !== chosen) select.value = chosen;
}

function facts(pairs) {
  const shown = pairs.filter(([, text]) => text);
  const list = $("facts");
  if (list.children.length !== 2 * shown.length)
    list.replaceChildren(...shown.flatMap(() => [el("dt"), el("dd")]));
  shown.forEach(([name, text], at) => { setText(list.children[2 * at], name); setText(list.children[2 * at + 1], text); });
}

let answerTimer = 0;
function answer(text, reasons, how) { // what went well makes room again
  clearTimeout(answerTimer);
  if (how === "good") answerTimer = setTimeout(answer, ANSWER_MS, "", [], "");
  const list = el("ul", null, {}, ...reasons.map((reason) => el("li", reason)));
  $("answer").className = how;
  $("answer").replaceChildren(...(text ? [el("span", text)] : []), ...(reasons.length ? [list] : []));
}

// -- requests -----------------------------------------------------------------------------
let promptTyped = false; // until it is set, the state does not overwrite it
$("prompt").addEventListener("input", () => { promptTyped = true; });
$("prompt-form").addEventListener("submit", (event) => { event.preventDefault(); send({ do: "prompt", text: $("prompt").value }); promptTyped = false; $("prompt").blur(); });
$("worker").addEventListener("change", () => { send({ do: "worker", name: $("worker").value }); $("worker").blur(); });
$("rate").addEventListener("change", () => { send({ do: "rate", hz: Number($("rate").value) }); $("rate").blur(); });
$("speed").addEventListener("input", () => setText($("speed-now"), `${$("speed").value} %`));
$("speed").addEventListener("change", () => { send({ do: "speed", percent: Number($("speed").value) }); $("speed").blur(); });
for (const name of ["activate", "deactivate", "reset"])
  $(name).addEventListener("click", () => { answer(`${name}...`, [], "quiet"); send({ do: name }); });

// -- stop ---------------------------------------------------------------------------------
let sound = null;
function buzz(pattern_ms, hz) { // felt on a phone, heard where nothing can be felt; [on, off, on, ...]
  if (navigator.vibrate && navigator.userActivation.hasBeenActive) navigator.vibrate(pattern_ms); // else browsers complain
  sound = sound || new AudioContext();
  sound.resume();
  let at = sound.currentTime;
  pattern_ms.forEach((ms, number) => {
    if (number % 2 === 0) {
      const tone = new OscillatorNode(sound, { frequency: hz }), quiet = new GainNode(sound, { gain: 0.15 });
      tone.connect(quiet).connect(sound.destination);
      tone.start(at);
      tone.stop(at + ms / 1000);
    }
    at += ms / 1000;
  });
}
function stop() {
  if (!welcome.drives) return;
  endHold();
  const began = (stopping = performance.now());
  buzz([150], 330);
  setText($("stop-words"), `stopping ${welcome.robot}...`);
  const sent = send({ do: "stop" });
  clearTimeout(stopTimer);
  if (!sent) post(began);
  else setTimeout(() => { if (stopping === began && state.state !== "stopped") post(began); }, POST_MS);
  stopTimer = setTimeout(() => { if (stopping === began) unconfirmed(); }, GIVE_UP_MS);
}
function post(began) {
  fetch("/stop", { method: "POST", headers: { Authorization: `Bearer ${token}` } })
    .then((found) => found.json())
    .then((report) => { if (stopping === began) showStopped(report); })
    .catch(() => { if (stopping === began) unconfirmed(); });
}
function unconfirmed() {
  stopping = 0;
  buzz([400, 100, 400], 220);
  setText($("stop-words"), `NOT CONFIRMED: no answer of robot ${welcome.robot}. The stop may still have arrived. USE THE ROBOT'S OWN EMERGENCY STOP`);
}
function showStopped(report) {
  const mine = stopping ? performance.now() - stopping : 0;
  stopping = 0;
  buzz(report.outcome === "confirmed" ? [70, 60, 70] : [400, 100, 400], report.outcome === "confirmed" ? 660 : 220);
  if (report.outcome !== "confirmed") { setText($("stop-words"), report.message); return; }
  const stood = `stood at ${clock(report.at_ms)}, ${seconds(mine ? mine / 1000 : report.stands_s)} after the ${mine ? "touch" : `stop by ${report.by}`}`;
  setText($("stop-words"), `${report.message}; ${stood}. Reset clears it.`);
  $("stop-words").dataset.standsMs = String(mine);
}
$("stop").addEventListener("pointerdown", (event) => { event.preventDefault(); stop(); });
$("stop").addEventListener("keydown", (event) => { if (event.key === "Enter") stop(); });
const typing = (node) => node.matches("input:not([type=range]), textarea, select");
window.addEventListener("keydown", (event) => {
  const enters = event.key === " " && (typing(event.target) || $("enter").open);
  if (event.repeat || (event.key !== "Escape" && event.key !== " ") || enters) return;
  event.preventDefault();
  stop();
}, true);

// -- hold-to-run --------------------------------------------------------------------------
function beginHold(way = NONE, grip = 0, primitive = "") {
  twist = way;
  opening = grip;
  if (holding || !welcome.drives || !control) return;
  press += 1;
  holding = performance.now();
  send(primitive ? { do: "primitive", press, tick, name: primitive } : { do: "hold", press, tick, hand: Boolean(grip) || way.some(Boolean) });
  beatTimer = setInterval(beat, BEAT_MS);
  $("hold").classList.add("held");
  setText($("hold"), "Let go to brake");
}
function beat() { send({ do: "beat", press, tick, twist, opening }); }
function endHold(why) {
  if (!holding) return;
  holding = 0;
  twist = NONE;
  opening = 0;
  clearInterval(beatTimer);
  send({ do: "release" });
  $("hold").classList.remove("held");
  setText($("hold"), "Hold to run");
  answer(why || "", [], "bad");
}
function holdable(button, begin) {
  button.addEventListener("pointerdown", (event) => { event.preventDefault(); button.setPointerCapture(event.pointerId); begin(); });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture", "blur"]) button.addEventListener(name, () => endHold());
  button.addEventListener("contextmenu", (event) => event.preventDefault());
  button.addEventListener("keydown", (event) => { if (event.key === "Enter" && !event.repeat) begin(); });
  button.addEventListener("keyup", (event) => { if (event.key === "Enter") endHold(); });
}
holdable($("hold"), () => beginHold());
document.addEventListener("visibilitychange", () => { if (document.hidden) endHold(); });
window.addEventListener("pagehide", () => endHold());
window.addEventListener("blur", () => endHold());

// -- by hand ------------------------------------------------------------------------------
const WAYS = [["x+", "forward"], ["x-", "back"], ["y+", "left"], ["y-", "right"], ["z+", "up"], ["z-", "down"],
  ["rx+", "roll +"], ["rx-", "roll -"], ["ry+", "pitch +"], ["ry-", "pitch -"], ["rz+", "yaw +"], ["rz-", "yaw -"]];
for (const [way, name] of WAYS) {
  const button = el("button", `${name} (${way})`, { disabled: true });
  const at = AXES.indexOf(way.slice(0, -1)), size = way.endsWith("+") ? 1 : -1;
  holdable(button, () => beginHold(NONE.map((_, axis) => (axis === at ? size : 0))));
  $("pad").append(button);
}
for (const [name, size] of [["open gripper", 1], ["close gripper", -1]]) {
  const button = el("button", name, { disabled: true });
  button.dataset.gripper = name;
  holdable(button, () => beginHold(NONE, size));
  $("pad").append(button);
}
for (const [name, what] of [["Home", "home"], ["Open", "open"], ["Close", "closed"]]) {
  const button = el("button", name, { disabled: true });
  if (what !== "home") button.dataset.gripper = what;
  holdable(button, () => beginHold(NONE, 0, what));
  $("primitives").append(button);
}
let handSeen = ""; // another page may have chosen since
function jog(on) { send({ do: "jog", on, frame: $("frame").value, level: Number($("level").value || 1), part: $("part").value }); }
function levels(given) {
  $("level").replaceChildren(...given.map((speed, at) => el("option", `${(speed * 100).toFixed(0)} cm/s`, { value: at })));
  $("level").value = "1";
}
$("take").addEventListener("click", () => jog(!state.jog));
for (const id of ["frame", "level", "part"]) $(id).addEventListener("change", () => { if (state.jog) jog(true); });

// -- recording ----------------------------------------------------------------------------
let recordingNow = false;
$("record-start").addEventListener("click", () => send({ do: "record", on: !recordingNow, verdict: $("verdict").value, note: $("note").value }));
function showRecording(message) {
  recordingNow = message.on;
  setText($("record-start"), message.on ? "Stop and keep" : "Record");
  setText($("recording"), message.text);
}

// -- the guide ----------------------------------------------------------------------------
const GUIDE = { // step -> its buttons: words, request, looks
  scene: [["Take", "take", "main"], ["Put the simulated scene back", "scene"], ["Finish now", "finish"], ["Cancel", "cancel"]],
  take: [["End the take", "end", "main"], ["Cancel", "cancel"]],
  judge: [["It succeeded", "success", "verdict"], ["It failed", "failure", "verdict"], ["Does not count", "void"], ["Go on with this take", "again"], ["Cancel", "cancel"]],
};
let guideStep = "";
function guide(step) { send({ do: "guide", step, prompt: $("guide-prompt").value, count: Number($("guide-count").value) || 10 }); }
$("guide-form").addEventListener("submit", (event) => { event.preventDefault(); guide("begin"); });
function showGuide(now, mode) {
  const free = now.step === "idle" || now.step === "done";
  setText($("guide-words"), now.text);
  $("guide-form").hidden = !free;
  $("guide-bar").hidden = free;
  Object.assign($("guide-bar"), { max: Math.max(1, now.wanted), value: now.kept });
  if (guideStep === now.step) return;
  const began = guideStep !== "";
  guideStep = now.step;
  for (const item of $("steps").children) {
    if (item.dataset.step === (now.step === "done" ? "export" : now.step)) item.setAttribute("aria-current", "step");
    else item.removeAttribute("aria-current");
  }
  $("guide-buttons").replaceChildren(...(GUIDE[now.step] || []).filter(([, step]) => step !== "scene" || mode === "sim").map(([words, step, looks]) => {
    const button = el("button", words, { type: "button", className: looks || "small" });
    button.addEventListener("click", () => guide(step));
    return button;
  }));
  if (began && !$("guide").hidden && !free) $("guide").scrollIntoView({ block: "nearest" });
}

$("save").addEventListener("click", () => send({ do: "save", note: $("note").value }));

// -- pictures -----------------------------------------------------------------------------
let offered = "", chosen = null;
const shown = new Map();
function title(name) { // seen/WORKER/CAMERA is what the model is given
  const [kind, one, camera] = name.split("/");
  return kind === "camera" ? one : kind === "depth" ? `${one}, depth` : `${camera} as ${one} sees it`;
}
function streams(seen) {
  const names = [...(welcome.pictures || []), ...seen];
  if (!welcome.drives || names.join() === offered) return;
  offered = names.join();
  if (chosen === null) chosen = new Set((welcome.pictures || []).filter((name) => name.startsWith("camera/")));
  $("streams").replaceChildren(...names.map((name) => {
    const button = el("button", title(name), { type: "button", className: "small" });
    button.setAttribute("aria-pressed", String(chosen.has(name)));
    button.addEventListener("click", () => {
      if (!chosen.delete(name)) chosen.add(name);
      button.setAttribute("aria-pressed", String(chosen.has(name)));
      look();
    });
    return button;
  }));
  look();
}
function watchPictures() {
  const socket = (pictures = socketTo("/pictures"));
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { socket.send(JSON.stringify({ do: "enter", token })); look(); };
  socket.onclose = (event) => { if (pictures === socket && control && event.code !== 1008) setTimeout(watchPictures, 1000); };
  socket.onmessage = async (event) => {
    if (typeof event.data === "string") return;
    const bytes = new Uint8Array(event.data), end = bytes.indexOf(10);
    const head = JSON.parse(new TextDecoder().decode(bytes.subarray(0, end)));
    try {
      const image = await createImageBitmap(new Blob([bytes.subarray(end + 1)], { type: "image/jpeg" }));
      draw(head, image);
      image.close();
    } catch { /* no picture: the next one may be */ }
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ do: "drawn", frame: head.frame }));
  };
}
function look() {
  for (const name of shown.keys()) if (!chosen.has(name)) { shown.get(name).figure.remove(); shown.delete(name); }
  for (const name of chosen || []) picture(name);
  const wanted = document.hidden || chosen === null ? [] : [...chosen];
  if (pictures && pictures.readyState === WebSocket.OPEN) pictures.send(JSON.stringify({ do: "look", streams: wanted, hz: PICTURE_HZ }));
}
document.addEventListener("visibilitychange", look);
function picture(name) {
  if (shown.has(name)) return shown.get(name);
  const canvas = el("canvas", null, { width: 640, height: 480 }), caption = el("figcaption", title(name));
  const touch = el("button", null, { type: "button", className: "picture" }, canvas);
  touch.setAttribute("aria-label", `picture of ${title(name)}, large`);
  touch.setAttribute("aria-pressed", "false");
  const figure = el("figure", null, {}, touch, caption);
  touch.addEventListener("click", () => enlarge(figure));
  $("pictures").append(figure);
  shown.set(name, { figure, canvas, caption, frames: 0, sinceMs: performance.now(), latency: [] });
  return shown.get(name);
}
function enlarge(figure) { // over the page, but for the dock with STOP; another touch puts it back
  for (const other of document.querySelectorAll("#pictures figure")) {
    const large = other === figure && !other.classList.contains("large");
    other.classList.toggle("large", large);
    other.firstChild.setAttribute("aria-pressed", String(large));
  }
}
function draw(head, image) {
  if (!chosen.has(head.name)) return;
  const view = picture(head.name);
  if (view.canvas.width !== image.width || view.canvas.height !== image.height) { view.canvas.width = image.width; view.canvas.height = image.height; }
  view.canvas.getContext("2d").drawImage(image, 0, 0);
  view.frames += 1;
  view.latency.push(Date.now() - head.stamp_ms);
  const took = performance.now() - view.sinceMs;
  if (took > 1000) {
    const sorted = view.latency.sort((a, b) => a - b);
    view.last = { hz: (1000 * view.frames) / took, ms: sorted[sorted.length >> 1] };
    setText(view.caption, `${title(head.name)}: ${view.last.hz.toFixed(0)} Hz, ${view.last.ms} ms old${head.said ? `, ${head.said} (red: near)` : ""}`);
    view.frames = 0; view.sinceMs = performance.now(); view.latency = [];
  }
}

// -- the arm ------------------------------------------------------------------------------
// Seen from far away (orthographic): lines keep their lengths, so distances can be compared.
const FROM = { "3-D": [-0.9, 0.45], front: [Math.PI / 2, 0], side: [0, 0], top: [0, Math.PI / 2] };
let [turn, tilt] = FROM["3-D"], dragged = null;
for (const [name, from] of Object.entries(FROM)) {
  const button = el("button", name, { className: "small", type: "button" });
  button.addEventListener("click", () => { [turn, tilt] = from; drawArms(state.arms || {}); });
  $("turns").append(button);
}
function turned(right, up) {
  turn += right;
  tilt = Math.min(Math.PI / 2, Math.max(-0.3, tilt + up));
  drawArms(state.arms || {});
}
$("space").addEventListener("pointerdown", (event) => { dragged = event; $("space").setPointerCapture(event.pointerId); });
$("space").addEventListener("pointermove", (event) => {
  if (!dragged) return;
  turned((dragged.clientX - event.clientX) / 150, (event.clientY - dragged.clientY) / 150);
  dragged = event;
});
for (const name of ["pointerup", "pointercancel"]) $("space").addEventListener(name, () => { dragged = null; });
const KEYS = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
$("space").addEventListener("keydown", (event) => { if (KEYS[event.key]) { event.preventDefault(); turned(...KEYS[event.key]); } });

function boxed([x, y, z]) { return [0, 1, 2, 3, 4, 5, 6, 7].map((at) => [x[at & 1], y[(at >> 1) & 1], z[at >> 2]]); }
const EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
const FACES = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];
function placed([x, y, z, yaw]) { // base frame of a part -> frame of the robot
  const c = Math.cos(yaw), s = Math.sin(yaw);
  return (p) => [x + c * p[0] - s * p[1], y + s * p[0] + c * p[1], z + p[2]];
}
function drawArms(arms) {
  const parts = Object.entries(welcome.surroundings || {}).map(([name, fixed]) => ({ name, fixed, arm: arms[name] || {}, at: placed(fixed.base) }));
  const canvas = $("space"), scale = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * scale), height = Math.round(canvas.clientHeight * scale);
  if (!width || !parts.length) return;
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const all = parts.flatMap(({ fixed, at }) => [...boxed(fixed.workspace), [0, 0, 0]].map(at));
  const middle = [0, 1, 2].map((axis) => (Math.min(...all.map((p) => p[axis])) + Math.max(...all.map((p) => p[axis]))) / 2);
  const reach = Math.max(...all.map((p) => Math.hypot(p[0] - middle[0], p[1] - middle[1], p[2] - middle[2])));
  const zoom = (0.56 * Math.min(width, height)) / reach;
  const [ca, sa, ce, se] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
  const see = (p) => {
    const [x, y, z] = [p[0] - middle[0], p[1] - middle[1], p[2] - middle[2]];
    return [width / 2 + zoom * (ca * x + sa * y), height / 2 - zoom * (se * (ca * y - sa * x) + ce * z)];
  };
  const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(`--${name}`);
  const pen = canvas.getContext("2d");
  pen.clearRect(0, 0, width, height);
  pen.lineJoin = pen.lineCap = "round";
  for (const { name, fixed, arm, at } of parts) {
    const path = (points) => { pen.beginPath(); for (const p of points) pen.lineTo(...see(at(p))); };
    const line = (points, ink, thick, dash = [], alpha = 1) => {
      path(points);
      Object.assign(pen, { strokeStyle: colour(ink), lineWidth: thick * scale, globalAlpha: alpha });
      pen.setLineDash(dash.map((each) => each * scale));
      pen.stroke();
      pen.setLineDash([]);
      pen.globalAlpha = 1;
    };
    const fill = (points, ink, alpha) => { path(points); Object.assign(pen, { fillStyle: colour(ink), globalAlpha: alpha }); pen.fill(); pen.globalAlpha = 1; };
    const dot = (p, ink, radius, full = true) => {
      pen.beginPath();
      pen.arc(...see(at(p)), radius * scale, 0, 7);
      Object.assign(pen, { fillStyle: colour(ink), strokeStyle: colour(ink), lineWidth: 2 * scale });
      if (full) pen.fill(); else pen.stroke();
    };
    const space = boxed(fixed.workspace), floor = fixed.table_z_m;
    if (floor !== null) fill([0, 1, 3, 2].map((corner) => [space[corner][0], space[corner][1], floor]), "space", 0.13);
    for (const [a, b] of EDGES) line([space[a], space[b]], "space", 1, [5, 5], 0.8);
    for (const shape of Object.values(fixed.keep_out)) keepOut(shape, fill, line, (p) => see(at(p)), pen, zoom, colour("keep-out"));
    for (const [axis, ink] of [[[0.12, 0, 0], "x-axis"], [[0, 0.12, 0], "y-axis"], [[0, 0, 0.12], "z-axis"]]) line([[0, 0, 0], axis], ink, 2);
    if (arm.links_m) {
      if (floor !== null) line(arm.links_m.map((p) => [p[0], p[1], floor]), "arm", 4, [], 0.25); // its shadow
      line(arm.links_m, "arm", 6);
      for (const joint of arm.links_m.slice(0, -1)) dot(joint, "arm", 4.5);
    }
    if (arm.chunk_m && arm.chunk_m.length) {
      line(arm.chunk_m, "chunk", 9, [], 0.3);
      line(arm.chunk_m, "chunk", 2);
      for (const p of arm.chunk_m.slice(1)) dot(p, "chunk", 2);
    }
    if (arm.held_m) for (const [a, b] of EDGES) line([arm.held_m[a], arm.held_m[b]], "arm", 2);
    if (arm.goal_m) dot(arm.goal_m, "goal", 8, false);
    if (arm.command_m) dot(arm.command_m, "command", 5);
    if (arm.measured_m) dot(arm.measured_m, "measured", 3);
    if (name) { pen.fillStyle = colour("ink"); pen.font = `${13 * scale}px system-ui, sans-serif`; pen.fillText(name, see(at([0, 0, 0]))[0] + 8 * scale, see(at([0, 0, 0]))[1] + 16 * scale); }
  }
  const where = parts.filter(({ arm }) => arm.measured_m).map(({ name, arm }) => {
    const [x, y, z] = arm.measured_m;
    return `TCP${name && ` of ${name}`} at x ${x.toFixed(3)}, y ${y.toFixed(3)}, z ${z.toFixed(3)} m`;
  });
  if (!welcome.no_arm) setText($("arm-words"), where.length ? `${where.join("; ")}, in the base frame` : "no state of the arm");
}
function keepOut(shape, fill, line, see, pen, zoom, ink) {
  const c = shape.centre_m;
  if (shape.radius_m) {
    pen.beginPath();
    pen.arc(...see(c), zoom * shape.radius_m, 0, 7);
    Object.assign(pen, { fillStyle: ink, globalAlpha: 0.3 });
    pen.fill();
    pen.globalAlpha = 1;
  } else if (shape.box_m) {
    const [a, b, h] = shape.box_m.map((edge) => edge / 2), at = placed([...c, shape.yaw_rad || 0]);
    const corners = boxed([[-a, a], [-b, b], [-h, h]]).map(at);
    for (const face of FACES) fill(face.map((corner) => corners[corner]), "keep-out", 0.15);
    for (const [one, other] of EDGES) line([corners[one], corners[other]], "keep-out", 1);
  } else { // a wall: a piece of it, and the side that is free
    const size = Math.hypot(...shape.normal), n = shape.normal.map((each) => each / size);
    const across = Math.abs(n[2]) < 0.9 ? [-n[1], n[0], 0] : [1, 0, 0], length = Math.hypot(...across), u = across.map((each) => each / length);
    const v = [n[1] * u[2] - n[2] * u[1], n[2] * u[0] - n[0] * u[2], n[0] * u[1] - n[1] * u[0]];
    const corner = (i, j) => c.map((each, axis) => each + 0.5 * (i * u[axis] + j * v[axis]));
    const wall = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    fill(wall, "keep-out", 0.2);
    line([...wall, wall[0]], "keep-out", 1);
    line([c, c.map((each, axis) => each + 0.1 * n[axis])], "keep-out", 2);
  }
}

// -- nodes and log ------------------------------------------------------------------------
const cells = (...texts) => texts.map((text) => (text instanceof Node ? el("td", null, {}, text) : el("td", text)));
function showNodes(message) {
  const pairs = (values, unit) => Object.entries(values).map(([name, value]) => `${name} ${value}${unit}`).join(", ");
  $("node-rows").replaceChildren(...message.nodes.map((node) => el("tr", null, {}, ...cells(
    node.name, el("span", node.state, { className: level(node.state) }), node.host, node.age_s === null ? "" : `${node.age_s} s`,
    pairs(node.rates_hz, " Hz"), pairs(node.refused, ""), node.why))));
  const stages = message.nodes.flatMap((node) => Object.entries(node.latency_ms).map(([stage, pair]) => [node.name, stage, ...pair]));
  const most = Math.max(1, ...stages.map((row) => row[3]));
  $("latency").replaceChildren(...stages.map(([node, stage, median, high]) => {
    const bar = el("meter", null, { min: 0, max: most, value: median });
    bar.setAttribute("aria-label", `${stage}, median`);
    return el("tr", null, {}, ...cells(node, stage.replaceAll("_", " "), `${median} ms`, `${high} ms`, bar));
  }));
  const clocks = message.clocks.map((pair) => el("tr", null, {}, ...cells(pair.seen_from, pair.host, `${pair.round_trip_ms.toFixed(2)} ms`,
    `${pair.offset_ms.toFixed(2)} ± ${pair.uncertainty_ms.toFixed(2)} ms`)));
  $("clocks").replaceChildren(...(clocks.length ? clocks : [el("tr", null, {}, el("td", "all nodes run on one host", { colSpan: 4 }))]));
  const down = Object.entries(message.hosts_down).map(([host, names]) => `Host ${host} does not run (${names.join(", ")}).`);
  $("hosts-down").hidden = !down.length;
  setText($("hosts-down"), down.join(" "));
}
function showEvent(event) {
  const words = `${event.node}: ${event.what}${event.count > 1 ? ` (x${event.count})` : ""}${event.why ? `: ${event.why}` : ""}`;
  const how = { error: "bad", warning: "warn" }[event.level] || "";
  $("events").prepend(el("li", null, { className: how }, el("time", clock(event.at_ms)), words));
  while ($("events").children.length > EVENTS) $("events").lastChild.remove();
}

// -- the last minute ----------------------------------------------------------------------
const MINUTE_MS = 60000, TREND_MS = 200;
const TRENDS = [ // name, unit, least top of the axis, colour
  ["speed", "cm/s", 10, "command"], ["latency", "ms", 50, "chunk"], ["force", "N", 10, "keep-out"], ["limits", "", 1, "warn"],
];
const past = [];
const trendViews = TRENDS.map(([name]) => {
  const canvas = el("canvas"), caption = el("figcaption", name);
  canvas.setAttribute("role", "img");
  $("lines").append(el("figure", null, {}, canvas, caption));
  return { canvas, caption };
});
function keepTrend(message, fastest) {
  const now = performance.now();
  if (past.length && now - past[past.length - 1].at < TREND_MS / 2) return;
  const speed = Object.values(message.arms || {}).some((arm) => arm.speed_m_s !== undefined) ? fastest * 100 : null;
  const names = message.limits.map((limit) => limit.split(":")[0].replaceAll("_", " "));
  past.push({ at: now, speed, latency: message.latency_ms, force: message.force_n, limits: names.length, names });
  while (past[0].at < now - MINUTE_MS) past.shift();
}
function drawTrends() {
  if (document.hidden || !past.length) return;
  const style = getComputedStyle(document.documentElement), scale = window.devicePixelRatio || 1, now = performance.now();
  TRENDS.forEach(([name, unit, least, ink], row) => {
    const { canvas, caption } = trendViews[row];
    const width = Math.round(canvas.clientWidth * scale), height = Math.round(canvas.clientHeight * scale);
    if (!width) return;
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const known = past.filter((each) => each[name] !== null), last = past[past.length - 1];
    const most = Math.max(0, ...known.map((each) => each[name])), top = 1.1 * Math.max(least, most);
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, width, height);
    Object.assign(pen, { strokeStyle: style.getPropertyValue(`--${ink}`), lineWidth: 2 * scale, lineJoin: "round" });
    pen.beginPath();
    let joined = false;
    for (const each of past) {
      const x = width * (1 - (now - each.at) / MINUTE_MS), y = height - scale - ((height - 2 * scale) * each[name]) / top;
      if (each[name] === null) joined = false;
      else { joined ? pen.lineTo(x, y) : pen.moveTo(x, y); joined = true; }
    }
    pen.stroke();
    const figure = (value) => (value === null ? "not measured" : `${value.toFixed(name === "latency" ? 0 : 1)} ${unit}`);
    const words = name === "limits"
      ? `limits: ${last.names.join(", ") || "none acts"}; in this minute: ${[...new Set(past.flatMap((each) => each.names))].join(", ") || "none"}`
      : `${name} ${figure(last[name])}; at most ${figure(known.length ? most : null)}`;
    setText(caption, words);
    canvas.setAttribute("aria-label", `${words}, in the last minute`);
  });
}
setInterval(drawTrends, TREND_MS);

// -- begin --------------------------------------------------------------------------------
new ResizeObserver(() => document.documentElement.style.setProperty("--dock", `${$("dock").offsetHeight}px`)).observe($("dock"));
const given = decodeURIComponent(location.hash.slice(1)) || sessionStorage.getItem("token") || "";
if (location.hash) history.replaceState(null, "", location.pathname); // the token stays out of the history
if (given) useToken(given);
else askToken("");
