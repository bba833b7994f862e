// What all drawings share: canvases of the right size, colours of the theme, drawing only what is seen and new.

const views = new Set();
let palette = null;

/** The theme's colours by name. */
export function colours() {
  if (!palette) {
    const style = getComputedStyle(document.documentElement);
    palette = new Proxy({}, {
      get: (known, name) => (known[name] ??= style.getPropertyValue(`--${name}`).trim()),
    });
  }
  return palette;
}

export function repaint() {
  palette = null;
  for (const view of views) view.dirty = true;
}

const seen = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) target.view.visible = isIntersecting;
}, { rootMargin: "80px" });
const sized = new ResizeObserver((entries) => {
  for (const { target } of entries) target.view.dirty = true;
});

/** A canvas drawn by `paint(context, width, height)` at most every `everyMs`, after `touch()`. */
export class View {
  constructor(canvas, everyMs, paint) {
    Object.assign(this, { canvas, everyMs, paint, dirty: true, visible: true, drawn: 0 });
    this.context = canvas.getContext("2d");
    canvas.view = this;
    seen.observe(canvas);
    sized.observe(canvas);
    views.add(this);
  }

  touch() {
    this.dirty = true;
  }

  draw(now) {
    if (!this.dirty || !this.visible || now - this.drawn < this.everyMs) return;
    const ratio = Math.min(2, devicePixelRatio || 1);
    const width = this.canvas.clientWidth;
    const height = this.canvas.clientHeight;
    if (!width || !height) return;
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (this.canvas.width !== w || this.canvas.height !== h) Object.assign(this.canvas, { width: w, height: h });
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.context.clearRect(0, 0, width, height);
    this.paint(this.context, width, height);
    this.dirty = false;
    this.drawn = now;
  }
}

function frame(now) {
  for (const view of views) view.draw(now);
  requestAnimationFrame(frame);
}
requestAnimationFrame(frame);

export const font = (size, weight = "") => `${weight} ${size}px system-ui, Roboto, "DejaVu Sans", sans-serif`;

/** The largest of 1, 2, 5 times a power of ten that is not above `value`. */
export function round125(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  const lead = value / power;
  return power * (lead >= 5 ? 5 : lead >= 2 ? 2 : 1);
}

const PREFIXES = [[1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"]];

/** Factor and prefix in which `size` reads well. */
export function prefix(size) {
  return PREFIXES.find(([factor]) => size >= factor * 0.9999) ?? PREFIXES.at(-1);
}
