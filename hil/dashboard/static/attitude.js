// Artificial horizon and compass in one drawing.
import { View, colours, font } from "./draw.js";

const RAD = Math.PI / 180;

/** A drawing of `attitude()`: [heading, pitch, roll] in degrees, or null. */
export function instrument(canvas, attitude, key) {
  return new View(canvas, 0, (c, width, height) => {
    const angles = attitude();
    const size = Math.min(width, height / 1.3);
    c.save();
    c.translate(width / 2, size / 2);
    horizon(c, size / 2 - 3, angles);
    c.restore();
    c.save();
    c.translate(width / 2, size * 1.04);
    compass(c, size / 2 - 3, size * 0.25, angles, colours()[key]);
    c.restore();
  });
}

function horizon(c, r, angles) {
  const paint = colours();
  const scale = r / 32; // pixels a degree
  c.save();
  c.beginPath();
  c.arc(0, 0, r, 0, 7);
  c.clip();
  if (!angles) {
    c.fillStyle = paint.grid;
    c.fillRect(-r, -r, 2 * r, 2 * r);
    c.restore();
    words(c, "no attitude yet", paint.faint);
    return;
  }
  const [, pitch, roll] = angles;
  c.save();
  c.rotate(-roll * RAD);
  c.translate(0, pitch * scale);
  const far = 2 * r + 180 * scale;
  c.fillStyle = paint.sky;
  c.fillRect(-far, -far, 2 * far, far);
  c.fillStyle = paint.earth;
  c.fillRect(-far, 0, 2 * far, far);
  c.strokeStyle = c.fillStyle = "#fff";
  c.lineWidth = 1.5;
  line(c, -far, 0, far, 0);
  c.font = font(Math.max(9, r * 0.1));
  c.textBaseline = "middle";
  for (let mark = -90; mark <= 90; mark += 5) {
    const y = -mark * scale;
    if (!mark || Math.abs(y + pitch * scale) > r * 0.72) continue;
    const half = r * (mark % 10 ? 0.12 : 0.24);
    line(c, -half, y, half, y);
    if (mark % 10) continue;
    c.textAlign = "right";
    c.fillText(Math.abs(mark), -half - 4, y);
    c.textAlign = "left";
    c.fillText(Math.abs(mark), half + 4, y);
  }
  c.restore();
  // Bank scale: turns with the sky, read at the fixed triangle.
  c.save();
  c.rotate(-roll * RAD);
  c.strokeStyle = "#fff";
  for (const mark of [-60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60]) {
    c.save();
    c.rotate(mark * RAD);
    c.lineWidth = mark % 30 ? 1 : 2.5;
    line(c, 0, -r, 0, -r * (mark % 30 ? 0.94 : 0.9));
    c.restore();
  }
  c.restore();
  c.fillStyle = "#ffd33d";
  c.beginPath();
  c.moveTo(0, -r * 0.89);
  c.lineTo(-r * 0.05, -r * 0.79);
  c.lineTo(r * 0.05, -r * 0.79);
  c.fill();
  c.strokeStyle = "#ffd33d";
  c.lineWidth = 3;
  c.beginPath();
  c.moveTo(-r * 0.55, 0);
  c.lineTo(-r * 0.2, 0);
  c.lineTo(0, r * 0.12);
  c.lineTo(r * 0.2, 0);
  c.lineTo(r * 0.55, 0);
  c.stroke();
  c.restore();
  c.strokeStyle = paint.line;
  c.lineWidth = 1;
  c.beginPath();
  c.arc(0, 0, r, 0, 7);
  c.stroke();
}

/** A strip of the rose, 90 degrees wide, under a fixed pointer. */
function compass(c, half, height, angles, colour) {
  const paint = colours();
  const scale = half / 45;
  c.fillStyle = paint.ground;
  c.strokeStyle = paint.line;
  c.beginPath();
  c.roundRect(-half, 0, 2 * half, height, 6);
  c.fill();
  c.stroke();
  if (!angles) return;
  const heading = ((angles[0] % 360) + 360) % 360;
  c.save();
  c.clip();
  c.strokeStyle = paint.faint;
  c.textAlign = "center";
  c.textBaseline = "alphabetic";
  for (let mark = Math.ceil((heading - 48) / 5) * 5; mark <= heading + 48; mark += 5) {
    const x = (mark - heading) * scale;
    const at = (mark + 720) % 360;
    c.lineWidth = at % 10 ? 1 : 1.5;
    line(c, x, height, x, height * (at % 10 ? 0.86 : 0.76));
    if (at % 30) continue;
    const name = { 0: "N", 90: "E", 180: "S", 270: "W" }[at];
    c.fillStyle = name ? paint.text : paint.faint;
    c.font = font(height * 0.24, name ? "700" : "");
    c.fillText(name ?? at, x, height * 0.7);
  }
  c.restore();
  c.fillStyle = colour;
  c.beginPath();
  c.moveTo(0, height * 0.74);
  c.lineTo(-5, height + 1);
  c.lineTo(5, height + 1);
  c.fill();
  const text = `${(Math.round(heading * 10) / 10 % 360).toFixed(1).padStart(5, "0")}°`;
  c.font = font(height * 0.3, "700");
  c.textAlign = "center";
  const wide = c.measureText(text).width / 2 + 6;
  c.fillStyle = paint.card;
  c.strokeStyle = colour;
  c.lineWidth = 1.5;
  c.beginPath();
  c.roundRect(-wide, 3, 2 * wide, height * 0.38, 5);
  c.fill();
  c.stroke();
  c.fillStyle = paint.text;
  c.textBaseline = "middle";
  c.fillText(text, 0, 3 + height * 0.2);
}

function words(c, text, colour) {
  c.fillStyle = colour;
  c.font = font(13);
  c.textAlign = "center";
  c.textBaseline = "middle";
  c.fillText(text, 0, 0);
}

function line(c, x0, y0, x1, y1) {
  c.beginPath();
  c.moveTo(x0, y0);
  c.lineTo(x1, y1);
  c.stroke();
}
