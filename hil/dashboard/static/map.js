// The track on a plain grid of metres, north up, with a scale.
import { View, colours, font, round125 } from "./draw.js";

const DEGREE_M = 111320;
const MOST = 2400;

/** Keeps the track and draws it. */
export class Track {
  constructor(canvas) {
    this.clear();
    this.view = new View(canvas, 150, (c, width, height) => this.paint(c, width, height));
  }

  clear(points = []) {
    this.points = points;
    this.last = null;
  }

  /** Take a place [lat, lon] in degrees, the velocity [north, east] and the heading. */
  take(place, velocity, heading) {
    const [lat, lon] = this.points.at(-1) ?? [Infinity, Infinity];
    const moved = Math.abs(place[0] - lat) + Math.abs(place[1] - lon);
    if (moved * DEGREE_M > 3) this.points.push([place[0], place[1]]);
    if (this.points.length > MOST) this.points = this.points.filter((_, k) => k % 2 === 0);
    this.last = { place, velocity, heading };
    this.view.touch();
  }

  paint(c, width, height) {
    const paint = colours();
    c.fillStyle = paint.ground;
    c.fillRect(0, 0, width, height);
    const all = this.last ? [...this.points, this.last.place] : this.points;
    if (!all.length) {
      c.fillStyle = paint.faint;
      c.font = font(13);
      c.textAlign = "center";
      c.fillText("no position yet", width / 2, height / 2);
      return;
    }
    const [lat0, lon0] = all[0];
    const east = Math.cos((lat0 * Math.PI) / 180) * DEGREE_M;
    const metres = all.map(([lat, lon]) => [(((lon - lon0 + 540) % 360) - 180) * east, (lat - lat0) * DEGREE_M]);
    const box = [0, 1].map((k) => {
      let [low, high] = [Infinity, -Infinity];
      for (const point of metres) [low, high] = [Math.min(low, point[k]), Math.max(high, point[k])];
      return [low, high];
    });
    const span = Math.max((box[0][1] - box[0][0]) / (width - 96), (box[1][1] - box[1][0]) / (height - 110), 0.4);
    const [x0, y0] = box.map(([low, high]) => (low + high) / 2);
    const place = ([x, y]) => [width / 2 + (x - x0) / span, height / 2 - 4 - (y - y0) / span];

    const step = round125(span * 110);
    this.grid(c, width, height, step, span, place);
    c.strokeStyle = paint.ours;
    c.lineWidth = 2;
    c.lineJoin = "round";
    c.beginPath();
    for (const point of metres) c.lineTo(...place(point));
    c.stroke();
    const [sx, sy] = place(metres[0]);
    c.fillStyle = paint.card;
    c.beginPath();
    c.arc(sx, sy, 4, 0, 7);
    c.fill();
    c.stroke();
    if (this.last) this.vehicle(c, place(metres.at(-1)), span);
    this.scale(c, height, step, span);
  }

  grid(c, width, height, step, span, place) {
    const [ox, oy] = place([0, 0]);
    const pixels = step / span;
    c.strokeStyle = colours().grid;
    c.lineWidth = 1;
    c.beginPath();
    for (let x = ox % pixels; x < width; x += pixels) {
      c.moveTo(Math.round(x) + 0.5, 0);
      c.lineTo(Math.round(x) + 0.5, height);
    }
    for (let y = oy % pixels; y < height; y += pixels) {
      c.moveTo(0, Math.round(y) + 0.5);
      c.lineTo(width, Math.round(y) + 0.5);
    }
    c.stroke();
  }

  vehicle(c, [x, y], span) {
    const paint = colours();
    const [north, east] = this.last.velocity;
    const length = Math.min(40, (Math.hypot(north, east) * 10) / span);
    c.save();
    c.translate(x, y);
    if (length > 4) {
      const angle = Math.atan2(east, north);
      c.strokeStyle = paint.y;
      c.lineWidth = 2;
      c.beginPath();
      c.moveTo(0, 0);
      c.lineTo(length * Math.sin(angle), -length * Math.cos(angle));
      c.stroke();
    }
    c.rotate((this.last.heading * Math.PI) / 180);
    c.fillStyle = paint.ours;
    c.strokeStyle = paint.card;
    c.lineWidth = 1.5;
    c.beginPath();
    c.moveTo(0, -10);
    c.lineTo(7, 8);
    c.lineTo(0, 4);
    c.lineTo(-7, 8);
    c.closePath();
    c.fill();
    c.stroke();
    c.restore();
  }

  scale(c, height, step, span) {
    const paint = colours();
    const length = step / span;
    c.strokeStyle = c.fillStyle = paint.text;
    c.lineWidth = 1.5;
    c.beginPath();
    c.moveTo(12, height - 17);
    c.lineTo(12, height - 11);
    c.lineTo(12 + length, height - 11);
    c.lineTo(12 + length, height - 17);
    c.stroke();
    c.font = font(11);
    c.textAlign = "left";
    c.textBaseline = "alphabetic";
    c.fillText(step >= 1000 ? `${step / 1000} km` : `${step} m`, 16, height - 16);
  }
}
