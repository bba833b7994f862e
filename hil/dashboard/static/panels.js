// The panels of words and numbers.

const $ = (id) => document.getElementById(id);
const MESSAGES = 200;
const LOSS_NAMES = {
  lost: "lost", duplicated: "duplicated", late: "late", crc_errors: "bad check", foreign: "foreign", short: "short",
  version_errors: "version", restarts: "restarts", frozen: "frozen", clock_steps: "clock steps",
  interpolated: "made up", silences: "silences", recorder_lost: "recorder",
};

export function put(id, text) {
  const element = typeof id === "string" ? $(id) : id;
  if (element.textContent !== text) element.textContent = text;
}

function made(tag, className, text) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text !== undefined) element.textContent = text;
  return element;
}

/** A definition list of [name, value, class], its elements kept. */
function facts(list, rows) {
  while (list.children.length > rows.length) list.lastChild.remove();
  rows.forEach(([name, value, className = ""], k) => {
    const item = list.children[k] ?? list.appendChild(made("div"));
    if (!item.firstChild) item.append(made("dt"), made("dd"));
    put(item.children[0], name);
    put(item.children[1], value);
    item.className = className;
    item.children[1].className = className === "new" ? "bad-text" : "";
  });
}

const bit = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));

function showAngles(row, angles) {
  const [heading, pitch, roll] = angles ?? [null, null, null];
  put(`${row}0`, heading === null ? "–" : (Math.round(heading * 100) / 100 % 360).toFixed(2));
  put(`${row}1`, bit(pitch, 2));
  put(`${row}2`, bit(roll, 2));
}

/** What a moment says in numbers. */
export function showMoment(now) {
  showAngles("a", now.att);
  showAngles("b", now.ref);
  const [north, east, down] = now.vel;
  const speed = Math.hypot(north, east);
  const track = ((Math.atan2(east, north) * 180) / Math.PI + 360) % 360;
  put("speed", `${speed.toFixed(speed < 100 ? 2 : 1)} m/s`);
  put("track", speed > 0.1 ? `${track.toFixed(1)}°` : "–");
  put("climb", `${(-down + 0).toFixed(2)} m/s`);
  put("height", `${now.place[2].toFixed(1)} m`);
  put("lat", `${now.place[0].toFixed(6)}°`);
  put("lon", `${now.place[1].toFixed(6)}°`);
}

/** What a person reads. */
export function showState(state) {
  const mode = $("mode");
  if (state.state === "starting") {
    put(mode, "preparing");
    mode.className = "badge";
    return;
  }
  const waiting = state.state === "waiting";
  const words = { NAVIGATE: "navigating", ALIGN: `aligning ${Math.round(100 * (state.progress ?? 0))} %`, DEGRADED: "degraded" };
  put(mode, state.state === "ended" ? "run ended" : waiting ? "no samples yet" : words[state.mode] ?? "waiting");
  const level = { NAVIGATE: "good", ALIGN: "warn", DEGRADED: "bad" }[state.mode] ?? "";
  mode.className = `badge ${state.state === "running" ? level : ""}`;
  showHealth(state.health);
  put("device-time", `${state.device_s.toFixed(1)} s`);
  put("rate", `${state.rate_hz.toFixed(0)} Hz`);
  put("age", `${(state.age_us / 1000).toFixed(2)} ms`);
  put("lost", String(state.losses.lost[0]));
  $("lost").className = state.losses.lost[1] ? "bad-text" : "";
  facts($("losses"), Object.entries(state.losses).map(([name, [count, fresh]]) =>
    [LOSS_NAMES[name] ?? name, String(count), fresh ? "new" : count ? "" : "zero"]));
  showSensor(state.sensor);
  showBus(state.bus);
  showLinks(state);
}

function showHealth(health) {
  const list = $("health");
  const names = health.map(({ name }) => name).join();
  if (list.dataset.names === names) return;
  list.dataset.names = names;
  list.replaceChildren(...health.map(({ name, bad }) =>
    made("span", `badge ${bad ? "bad" : "warn"}`, name.toLowerCase().replaceAll("_", " "))));
}

function showSensor({ axes, temperature, spin }) {
  const names = Object.entries(axes);
  const list = $("axes");
  const text = JSON.stringify(names);
  if (list.dataset.text !== text) {
    list.dataset.text = text;
    list.replaceChildren(...names.map(([name, fault]) =>
      made("li", `badge ${fault ? "bad" : "good"}`, fault ? `${name} ${fault}` : name)));
  }
  $("head-facts").hidden = !names.length;
  temperature.forEach((value, k) => put(`temp${k}`, value === null ? "–" : `${value.toFixed(1)} °C`));
  spin.forEach((value, k) => put(`spin${k}`, value === null ? "–" : `${value.toFixed(2)} Hz`));
}

function showBus(bus) {
  const percent = 100 * bus.load;
  $("load-bar").style.width = `${Math.min(100, percent)}%`;
  $("load-bar").className = percent > 90 ? "bad" : percent > 70 ? "warn" : "";
  put("load", `${percent.toFixed(0)} %`);
  put("frames", `${bus.frames_s.toFixed(0)} /s`);
  put("bytes", `${(bus.bytes_s / 1000).toFixed(1)} kB/s`);
}

function showLinks({ links, sent_hz: sent }) {
  const body = $("links").tBodies[0];
  while (body.rows.length > links.length) body.deleteRow(-1);
  links.forEach((link, k) => {
    const row = body.rows[k] ?? body.insertRow();
    if (!row.cells.length) row.append(made("th"), ...Array.from({ length: 6 }, () => made("td")));
    [link.url, link.sent_hz.toFixed(0), link.received, link.refused, link.bad, link.dropped, link.lost].forEach((value, i) =>
      put(row.cells[i], String(value)));
  });
  facts($("sent"), Object.entries(sent).map(([name, rate]) => [name, `${rate.toFixed(rate < 9.5 ? 1 : 0)} Hz`]));
}

/** Add a message; the newest stands on top. */
export function addMessage({ t, severity, text }) {
  const item = made("li", severity);
  item.append(made("time", "", `${t.toFixed(2)} s`), made("span", "", text));
  const list = $("messages");
  list.prepend(item);
  while (list.children.length > MESSAGES) list.lastChild.remove();
}

export function clearMessages() {
  $("messages").replaceChildren();
}

export function notice(text) {
  $("notice").hidden = !text;
  put("notice", text);
}
