// Points on the screen: the nearest to a place, and the next one in a direction.

export type Direction = "left" | "right" | "up" | "down";

const AXES: Record<Direction, [number, number]> = {
  left: [-1, 0], right: [1, 0], up: [0, -1], down: [0, 1],
};

/** Index of the point nearest to (x, y), at most `reach` away; -1 without one. */
export function nearest(
  xs: ArrayLike<number>, ys: ArrayLike<number>, x: number, y: number, reach: number,
): number {
  let best = -1, least = reach * reach;
  for (let i = 0; i < xs.length; i++) {
    const dx = xs[i]! - x, dy = ys[i]! - y, squared = dx * dx + dy * dy;
    if (squared < least) { least = squared; best = i; }
  }
  return best;
}

/**
 * Index of the next point from (x, y) in a direction: within 45 degrees of it, the one with the
 * least sum of the way along it and twice the way across. -1 without one.
 */
export function next(
  xs: ArrayLike<number>, ys: ArrayLike<number>, x: number, y: number, direction: Direction,
): number {
  const [ax, ay] = AXES[direction];
  let best = -1, least = Infinity;
  for (let i = 0; i < xs.length; i++) {
    const dx = xs[i]! - x, dy = ys[i]! - y;
    const along = dx * ax + dy * ay, across = Math.abs(dx * ay - dy * ax);
    if (along <= 1e-6 || across > along) continue;
    const cost = along + 2 * across;
    if (cost < least) { least = cost; best = i; }
  }
  return best;
}
