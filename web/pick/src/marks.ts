// Crosses with a dark edge, which can be seen on any image, and the loupe.

import type { Pixel } from "./api";

export const MARK = "#ffffff", MARK_EDGE = "#000000", CHOSEN = "#ff40ff", HINT = "#ffe14d";
const LOUPE_SIDE = 132, LOUPE_ZOOM = 8;
const ARMS = [[1, 0], [-1, 0], [0, 1], [0, -1]] as const;

export function paintMark(
  c: CanvasRenderingContext2D, [x, y]: [number, number], colour: string, label: string,
): void {
  const ratio = window.devicePixelRatio || 1, reach = 9 * ratio, gap = 3 * ratio;
  paintCross(c, x, y, gap, reach, [[3.5 * ratio, MARK_EDGE], [1.5 * ratio, colour]]);
  if (!label) return;
  c.font = `600 ${13 * ratio}px system-ui, sans-serif`;
  c.lineWidth = 3 * ratio;
  c.strokeStyle = MARK_EDGE;
  c.strokeText(label, x + reach, y - gap);
  c.fillStyle = colour;
  c.fillText(label, x + reach, y - gap);
}

function paintCross(
  c: CanvasRenderingContext2D, x: number, y: number, gap: number, reach: number,
  strokes: [number, string][],
): void {
  c.beginPath();
  for (const [ax, ay] of ARMS) {
    c.moveTo(x + gap * ax, y + gap * ay);
    c.lineTo(x + reach * ax, y + reach * ay);
  }
  for (const [width, colour] of strokes) {
    c.lineWidth = width;
    c.strokeStyle = colour;
    c.stroke();
  }
}

/** The pixels about one, enlarged; empty without an image. */
export function paintLoupe(
  loupe: HTMLCanvasElement, image: HTMLImageElement | null, centre: Pixel | null,
): void {
  if (loupe.width !== LOUPE_SIDE) loupe.width = loupe.height = LOUPE_SIDE;
  const c = loupe.getContext("2d", { alpha: false })!, half = LOUPE_SIDE / 2;
  c.fillStyle = "#101418";
  c.fillRect(0, 0, LOUPE_SIDE, LOUPE_SIDE);
  if (!centre || !image) return;
  c.imageSmoothingEnabled = false;
  const x = half - LOUPE_ZOOM * (centre[0] + 0.5), y = half - LOUPE_ZOOM * (centre[1] + 0.5);
  c.drawImage(image, x, y, LOUPE_ZOOM * image.naturalWidth, LOUPE_ZOOM * image.naturalHeight);
  paintCross(c, half, half, 4, 24, [[3, MARK_EDGE], [1.5, HINT]]);
}
