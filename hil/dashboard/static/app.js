// The page: what comes from the bridge goes to the drawings and panels, buttons and keys go to the bridge.
import { instrument } from "./attitude.js";
import { repaint } from "./draw.js";
import { connect } from "./link.js";
import { Track } from "./map.js";
import { addMessage, clearMessages, notice, put, showMoment, showState } from "./panels.js";
import { Histogram, Plot } from "./plot.js";

const $ = (id) => document.getElementById(id);
const AXES = ["x", "y", "z"];
const NUMBERS_MS = 100;
const MOVING_MS = 1;

let now = null;
let shownNumbers = 0;
let run = "";
let moments = 0;

const lines = (names) => names.map((name, k) => ({ name, colour: AXES[k] }));
const ours = instrument($("ours"), () => now?.att, "ours");
const reference = instrument($("reference"), () => now?.ref, "truth");
const track = new Track($("map"));
const plots = {
  rates: new Plot($("rates"), lines(["x forward", "y right", "z down"])),
  forces: new Plot($("forces"), lines(["x forward", "y right", "z down"])),
  parity: new Plot($("parity"), [{ name: "mean", colour: "x" }, { name: "largest", colour: "y" }]),
};
const errors = ["position", "velocity", "attitude"].flatMap((what, group) =>
  ["north", "east", "down"].map((axis, k) => {
    const canvas = document.createElement("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `error of ${what}, ${axis}`);
    $("error-plots").append(canvas);
    const title = `${what} ${axis}`;
    const unit = ["m", "m/s", "°"][group];
    return new Plot(canvas, [{ name: title, colour: AXES[k] }], { bands: true, unit, title, everyMs: 180 });
  }));
const histograms = {
  age: new Histogram($("age-histogram"), "age", "x"),
  jitter: new Histogram($("jitter-histogram"), "jitter", "z"),
};

function begin(hello) {
  if (hello.run === run) return;
  run = hello.run;
  now = null;
  put("scenario", hello.scenario);
  document.title = `${hello.scenario} – dtg-hil`;
  put("bus", hello.bus);
  for (const plot of [...Object.values(plots), ...errors]) plot.clear();
  track.clear(hello.track);
  clearMessages();
  hello.events.forEach(addMessage);
  $("faults").hidden = !Object.keys(hello.faults).length;
  $("fault").replaceChildren(...Object.entries(hello.faults).map(([code, text]) => new Option(text, code)));
  $("record").disabled = !hello.can_record;
  for (const histogram of Object.values(histograms)) histogram.edges = hello.edges_us;
}

function takeMoment(moment) {
  now = moment;
  moments += 1;
  ours.touch();
  reference.touch();
  plots.rates.take(moment.t, moment.w);
  plots.forces.take(moment.t, moment.f);
  plots.parity.take(moment.t, moment.parity);
  if (moment.err) errors.forEach((plot, k) => plot.take(moment.t, [moment.err[k], moment.sig3[k]]));
  if (moment.att) track.take(moment.place, moment.vel, moment.att[0]);
  const time = performance.now();
  if (time - shownNumbers < NUMBERS_MS) return;
  shownNumbers = time;
  showMoment(moment);
  const compared = moment.ref !== null;
  $("reference-figure").hidden = $("reference-row").hidden = !compared;
  document.querySelector(".pair").classList.toggle("single", !compared);
  if (moment.err && $("errors").hidden) $("errors").hidden = false;
  put("errors-note", moment.sig3[0] === null ? "against the truth; this run estimates no sigma" : "against the truth, ±3σ shaded");
  $("parity-card").hidden = moment.parity[0] === null;
}

function takeState(state) {
  showState(state);
  if (!state.hist) return;
  for (const [name, counts] of Object.entries(state.hist)) histograms[name].take(counts);
  const recording = state.recording !== "";
  $("record").setAttribute("aria-pressed", String(recording));
  put("record", recording ? "Stop recording" : "Record");
  $("record").title = recording ? `end the recording ${state.recording} (r)` : "start or end a recording (r)";
}

const takers = {
  hello: begin,
  fast: takeMoment,
  slow: takeState,
  event: addMessage,
  refused: ({ text }) => notice(text),
};

const link = connect(
  (record) => takers[record.k]?.(record),
  (state) => {
    document.documentElement.dataset.link = state;
    notice({
      open: "",
      lost: "connection lost: trying again",
      refused: "refused: open the address with the token that the terminal shows",
    }[state]);
    if (state === "open") return;
    $("mode").className = "badge bad";
    put("mode", "not connected");
  },
);

let counted = performance.now();
setInterval(() => {
  const time = performance.now();
  put("updates", `${((1000 * moments) / (time - counted)).toFixed(0)} Hz`);
  [moments, counted] = [0, time];
}, 1000);

/** A moving vehicle is not aligned by a slip of the finger: the button is pressed twice. */
function align() {
  const button = $("align");
  const moving = now && Math.hypot(...now.vel) > MOVING_MS;
  if (moving && !button.classList.contains("sure")) {
    button.classList.add("sure");
    put(button, "Align in motion?");
    setTimeout(() => {
      button.classList.remove("sure");
      put(button, "Align");
    }, 3000);
    return;
  }
  button.classList.remove("sure");
  put(button, "Align");
  link.send({ do: "align" });
}

const orders = {
  a: [$("align"), align],
  r: [$("record"), () => link.send({ do: "record" })],
  m: [$("mark"), () => link.send({ do: "mark" })],
  f: [$("inject"), () => link.send({ do: "inject", fault: $("fault").value })],
};
for (const [button, act] of Object.values(orders)) button.addEventListener("click", act);
document.addEventListener("keydown", (event) => {
  const typing = event.target.closest("select, input") || event.ctrlKey || event.altKey || event.metaKey || event.repeat;
  const [button] = orders[event.key] ?? [];
  if (!typing && button && button.offsetParent !== null) button.click();
});

const dark = matchMedia("(prefers-color-scheme: dark)");
function wear(theme) {
  document.documentElement.dataset.theme = theme;
  repaint();
}
wear(localStorage.getItem("theme") ?? (dark.matches ? "dark" : "light"));
dark.addEventListener("change", () => localStorage.getItem("theme") ?? wear(dark.matches ? "dark" : "light"));
$("theme").addEventListener("click", () => {
  const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  localStorage.setItem("theme", theme);
  wear(theme);
});
