// The cloud as the LiDAR sees it: columns are azimuths, rows elevations, in the camera's axes.

export const PER_DEGREE = 10; // units of content
const DEGREES = 180 / Math.PI;
const NEAR = 12; // pixels of the screen within which a point is picked

// Azimuth and elevation of points (x, y, z, intensity), turned as the camera is by the guess.
export class Panorama {
  constructor(cloud, T) {
    const count = cloud.length / 4;
    this.cloud = cloud;
    this.places = new Float32Array(2 * count);
    this.range = new Float32Array(count);
    for (let i = 0; i < count; i++) {
      const [u, v] = place(T, cloud[4 * i], cloud[4 * i + 1], cloud[4 * i + 2]);
      this.places.set([u, v], 2 * i);
      this.range[i] = Math.hypot(cloud[4 * i], cloud[4 * i + 1], cloud[4 * i + 2]);
    }
    // Far points are drawn first: near ones hide them.
    this.order = Uint32Array.from({ length: count }, (_, i) => i).sort(
      (a, b) => this.range[b] - this.range[a]);
    this.colours = {};
  }

  // The colour of every point, 0 to 1: its rank, so that all of the scale is used.
  shades(kind) {
    if (!this.colours[kind]) {
      const values = kind === "range" ? this.range : this.intensities();
      const order = Array.from(values.keys()).sort((a, b) => values[a] - values[b]);
      const shades = new Float32Array(values.length);
      order.forEach((i, rank) => { shades[i] = rank / Math.max(1, order.length - 1); });
      this.colours[kind] = shades;
    }
    return this.colours[kind];
  }

  intensities() {
    return Float32Array.from(this.range, (_, i) => this.cloud[4 * i + 3] || 0);
  }

  draw(context, view, kind) {
    const [left, top, right, bottom] = view.visible();
    const dot = Math.max(2, Math.min(view.scale * PER_DEGREE * 0.35, 6));
    const shades = this.shades(kind);
    for (const i of this.order) {
      const u = this.places[2 * i], v = this.places[2 * i + 1];
      if (u < left || u > right || v < top || v > bottom) continue;
      const [x, y] = view.toScreen(u, v);
      context.fillStyle = kind === "intensity" ? GREYS[(shades[i] * 63) | 0] : RAINBOW[(shades[i] * 63) | 0];
      context.fillRect(x - dot / 2, y - dot / 2, dot, dot);
    }
  }

  // The point nearest to a place of content; near ones win over those that they hide.
  nearest(view, u, v) {
    let best = null, least = NEAR / view.scale;
    for (let k = this.order.length - 1; k >= 0; k--) {
      const i = this.order[k];
      const distance = Math.hypot(this.places[2 * i] - u, this.places[2 * i + 1] - v);
      if (distance < least * 0.98) [best, least] = [i, distance];
    }
    return best === null ? null : Array.from(this.cloud.subarray(4 * best, 4 * best + 3));
  }
}

// The place of a point (x, y, z) of the LiDAR's frame on the panorama.
export function place(T, x, y, z) {
  const [right, down, ahead] = T.slice(0, 3).map((row) => row[0] * x + row[1] * y + row[2] * z);
  const azimuth = Math.atan2(right, ahead) * DEGREES;
  const elevation = Math.atan2(-down, Math.hypot(right, ahead)) * DEGREES;
  return [(180 + azimuth) * PER_DEGREE, (90 - elevation) * PER_DEGREE];
}

const hue = (share) => `hsl(${Math.round(260 * share)} 90% ${45 + 12 * Math.sin(Math.PI * share)}%)`;
export const RAINBOW = Array.from({ length: 64 }, (_, i) => hue(i / 63));
const GREYS = Array.from({ length: 64 }, (_, i) => `hsl(0 0% ${Math.round(12 + (i / 63) * 88)}%)`);
