// Scrolling plots of the last half minute, and histograms.
import { View, colours, font, prefix, round125 } from "./draw.js";

const SPAN_S = 30;
const NAMES_WIDTH = 46;

/** Lines over time; `take(time, values)` adds a point, null leaves a gap. */
export class Plot {
  /** `series`: [{name, colour}]; `bands`: values are followed by as many half widths of a band; `unit`: with a prefix. */
  constructor(canvas, series, { bands = false, unit = "", title = "", everyMs = 90 } = {}) {
    Object.assign(this, { series, bands, unit, title });
    this.clear();
    this.view = new View(canvas, everyMs, (c, width, height) => this.paint(c, width, height));
  }

  clear() {
    this.times = [];
    this.rows = [];
  }

  get length() {
    return this.times.length;
  }

  take(time, values) {
    if (time <= this.times.at(-1)) {
      if (this.times.at(-1) - time < 1) return;
      this.clear(); // the device's clock began anew
    }
    this.times.push(time);
    this.rows.push(values);
    const old = this.times.findIndex((one) => one > time - SPAN_S - 1);
    if (old > 200) {
      this.times.splice(0, old);
      this.rows.splice(0, old);
    }
    this.view.touch();
  }

  paint(c, width, height) {
    const paint = colours();
    const [left, top, right, bottom] = [NAMES_WIDTH, 18, width - 2, height - (this.title ? 6 : 16)];
    const count = this.series.length;
    const end = this.times.at(-1) ?? 0;
    let [low, high] = [Infinity, -Infinity];
    this.rows.forEach((row, k) => {
      if (this.times[k] < end - SPAN_S) return;
      for (let i = 0; i < count; i++) {
        if (row[i] === null) continue;
        const band = this.bands && row[count + i] !== null ? Math.min(row[count + i], 8 * Math.abs(row[i]) + 1e-12) : 0;
        low = Math.min(low, row[i], -band || Infinity);
        high = Math.max(high, row[i], band || -Infinity);
      }
    });
    if (low > high) [low, high] = [-1, 1];
    const room = Math.max((high - low) * 0.08, Math.abs(high) * 1e-4, 1e-12);
    [low, high] = [low - room, high + room];
    const x = (time) => right - ((end - time) / SPAN_S) * (right - left);
    const y = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);

    this.axes(c, { left, right, low, high, y, height });
    c.save();
    c.beginPath();
    c.rect(left, top - 1, right - left, bottom - top + 2);
    c.clip();
    for (let i = 0; i < count; i++) {
      if (this.bands) this.band(c, i, count, x, y, end);
      c.strokeStyle = paint[this.series[i].colour];
      c.lineWidth = 1.4;
      this.line(c, i, x, y, end);
    }
    c.restore();
    if (this.title) return;
    let at = left;
    c.font = font(11);
    c.textAlign = "left";
    c.textBaseline = "middle";
    for (const { name, colour } of this.series) {
      c.fillStyle = paint[colour];
      c.fillRect(at, 6, 12, 3);
      c.fillStyle = paint.faint;
      c.fillText(name, at + 16, 8);
      at += 28 + c.measureText(name).width;
    }
  }

  axes(c, { left, right, low, high, y, height }) {
    const paint = colours();
    const step = round125((high - low) / (this.title ? 2 : 3));
    const size = Math.max(Math.abs(low), Math.abs(high));
    const [factor, letter] = this.unit ? prefix(Math.max(step, size / 100)) : [1, ""];
    const digits = Math.max(0, Math.min(6, Math.ceil(-Math.log10(step / factor) - 1e-9)));
    c.strokeStyle = paint.grid;
    c.lineWidth = 1;
    c.font = font(11);
    c.textAlign = "right";
    c.textBaseline = "middle";
    c.fillStyle = paint.faint;
    for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
      const at = Math.round(y(value)) + 0.5;
      c.beginPath();
      c.moveTo(left, at);
      c.lineTo(right, at);
      c.stroke();
      c.fillText(((Math.abs(value) < step / 1e6 ? 0 : value) / factor).toFixed(digits), left - 5, at);
    }
    if (this.title) {
      c.textAlign = "left";
      c.fillStyle = paint.text;
      c.fillText(this.title, left, 8);
      const after = c.measureText(this.title).width;
      c.fillStyle = paint.faint;
      c.fillText(`${letter}${this.unit}`, left + after + 7, 8);
      return;
    }
    c.textBaseline = "alphabetic";
    for (let second = 0; second <= SPAN_S; second += 10) {
      c.textAlign = second === 0 ? "right" : second === SPAN_S ? "left" : "center";
      c.fillText(second ? `−${second} s` : "now", right - (second / SPAN_S) * (right - left), height - 3);
    }
  }

  line(c, i, x, y, end) {
    let pen = false;
    c.beginPath();
    for (let k = 0; k < this.rows.length; k++) {
      const value = this.rows[k][i];
      if (value === null || this.times[k] < end - SPAN_S - 1 || this.times[k] - this.times[k - 1] > 0.5) pen = false;
      if (value === null) continue;
      if (pen) c.lineTo(x(this.times[k]), y(value));
      else c.moveTo(x(this.times[k]), y(value));
      pen = true;
    }
    c.stroke();
  }

  /** Plus and minus the half width, shaded. */
  band(c, i, count, x, y, end) {
    const known = [];
    this.rows.forEach((row, k) => {
      if (row[count + i] !== null && this.times[k] >= end - SPAN_S - 1) known.push([x(this.times[k]), row[count + i]]);
    });
    if (!known.length) return;
    c.fillStyle = colours().band;
    c.beginPath();
    for (const [at, half] of known) c.lineTo(at, y(half));
    for (const [at, half] of known.reverse()) c.lineTo(at, y(-half));
    c.fill();
  }
}

/** Counts by time in microseconds; both axes are logarithmic. */
export class Histogram {
  constructor(canvas, title, colour) {
    Object.assign(this, { title, colour, edges: [], counts: [] });
    this.view = new View(canvas, 200, (c, width, height) => this.paint(c, width, height));
  }

  take(counts) {
    this.counts = counts;
    this.view.touch();
  }

  paint(c, width, height) {
    const paint = colours();
    const [left, top, bottom] = [4, 18, height - 16];
    c.font = font(11);
    c.textBaseline = "middle";
    c.textAlign = "left";
    c.fillStyle = paint.text;
    c.fillText(this.title, left, 8);
    const total = this.counts.reduce((sum, one) => sum + one, 0);
    const wide = (width - 2 * left) / Math.max(1, this.counts.length);
    c.strokeStyle = paint.grid;
    c.beginPath();
    c.moveTo(left, bottom + 0.5);
    c.lineTo(width - left, bottom + 0.5);
    c.stroke();
    if (!total) return;
    c.fillStyle = paint.faint;
    c.textAlign = "right";
    c.fillText(`half below ${this.below(0.5, total)}, 99 % below ${this.below(0.99, total)}`, width - left, 8);
    const full = Math.log10(Math.max(...this.counts) + 1);
    this.counts.forEach((count, k) => {
      const high = count ? Math.max(2, (Math.log10(count + 1) / full) * (bottom - top)) : 0;
      c.fillStyle = paint[this.colour];
      c.fillRect(left + k * wide + 1, bottom - high, wide - 2, high);
    });
    c.fillStyle = paint.faint;
    c.textAlign = "center";
    c.textBaseline = "alphabetic";
    this.edges.forEach((edge, k) => {
      if (String(edge)[0] === "1") c.fillText(readable(edge), left + (k + 1) * wide, height - 3);
    });
  }

  below(share, total) {
    let sum = 0;
    const place = this.counts.findIndex((count) => (sum += count) >= share * total);
    return place < this.edges.length ? readable(this.edges[place]) : "more";
  }
}

const readable = (us) => (us >= 1000 ? `${us / 1000} ms` : `${us} µs`);
