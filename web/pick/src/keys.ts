// The keyboard: one table of what each key does, shown in the help.

import type { Direction } from "./nearest";

export const DIRECTIONS: Record<string, Direction> = {
  ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down",
};

export const HELP: [string, string][] = [
  ["Arrows, in the image", "move the cross by 1 pixel; with Shift 10, with Alt 0.1"],
  ["Enter, in the image", "take the pixel; then arrows go from point to point, Enter takes one"],
  ["Arrows, in the cloud", "go from point to point; with Shift turn the view"],
  ["Enter, in the cloud", "take the point"],
  ["+  −  0", "zoom, and back"],
  ["V, in the cloud", "look from the camera"],
  ["K", "move the pixel to the corner near it"],
  ["Esc", "drop the pixel and the point that are not yet a pair"],
  ["U  R", "undo, redo (or Ctrl+Z, Ctrl+Shift+Z)"],
  ["N  P  C", "next frame, previous frame, next camera"],
  ["[  ]", "more image, more cloud"],
  ["E", "points at the guess or at the estimate"],
  ["M", "take points from the image or from the cloud"],
  ["S", "write the reference"],
];

/** Calls what a key stands for, unless a field is being edited; true if it did. */
export function onKey(event: KeyboardEvent, actions: Record<string, () => void>): boolean {
  const target = event.target as HTMLElement;
  if (target.matches("input:not([type=checkbox],[type=radio]),select,textarea") && event.key.length === 1) return false;
  const undo = (event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z";
  if (!undo && (event.ctrlKey || event.metaKey || event.altKey)) return false;
  const action = actions[undo ? (event.shiftKey ? "r" : "u") : event.key.toLowerCase()];
  if (!action) return false;
  event.preventDefault();
  action();
  return true;
}
