// Colours of distances: near is red, far is blue, linear in the logarithm.

const NEAR_M = 2, FAR_M = 60;
export const LEVELS = 64;

/** Level of a distance [m], 0 near to LEVELS - 1 far. */
export function levelOf(distance: number): number {
  const share = Math.log(distance / NEAR_M) / Math.log(FAR_M / NEAR_M);
  return Math.max(0, Math.min(LEVELS - 1, Math.floor(share * LEVELS)));
}

/** Red, green and blue, 0 to 1, of a level: hues from red to blue, of about one lightness. */
export function rgbOf(level: number): [number, number, number] {
  const hue = (240 * level) / (LEVELS - 1) / 60;
  const rise = 1 - Math.abs((hue % 2) - 1);
  if (hue < 1) return [1, 0.25 + 0.75 * rise, 0.1];
  if (hue < 2) return [0.25 + 0.75 * rise, 1, 0.1];
  if (hue < 3) return [0.1, 1, 0.25 + 0.75 * rise];
  return [0.25, 0.25 + 0.75 * rise, 1];
}

export const cssOf = (level: number): string =>
  `rgb(${rgbOf(level).map((part) => Math.round(255 * part)).join(" ")})`;
