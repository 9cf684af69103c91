// The image with the projected points over it: zoom, cursor, loupe. Pixel (0, 0) is the centre of
// the top-left pixel, so that the image begins at (-0.5, -0.5).

import type { Advice, Pair, Pixel, Visible } from "./api";
import { cssOf, LEVELS, levelOf } from "./colours";
import { CHOSEN, HINT, MARK, MARK_EDGE, paintLoupe, paintMark } from "./marks";
import { nearest, next, type Direction } from "./nearest";

const MAX_ZOOM = 40, CLICK_PX = 4, REACH_PX = 12;

export interface ImageEvents {
  pixel(pixel: Pixel): void;
  point(row: number): void;
}

export class ImageView {
  private readonly context: CanvasRenderingContext2D;
  private image: HTMLImageElement | null = null;
  private visible: Visible | null = null;
  private byLevel: number[][] = [];
  private zoom = 1;
  private left = 0; // of the image on the canvas
  private top = 0;
  private readonly pointers = new Map<number, [number, number]>();
  private moved = 0;
  private pinch = 0;
  private hover: Pixel | null = null;
  private queued = false;

  blend = 0.5;
  cursor: Pixel | null = null;
  pending: Pixel | null = null;
  chosenRow = -1;
  picksPoints = false;
  pairs: { place: number; pair: Pair; suspicious: boolean }[] = [];
  selected = -1;
  advice: Advice | null = null;

  constructor(
    readonly canvas: HTMLCanvasElement, readonly loupe: HTMLCanvasElement,
    private readonly events: ImageEvents,
  ) {
    this.context = canvas.getContext("2d", { alpha: false })!;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.up(event));
    canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("pointerleave", () => { this.hover = null; this.draw(); });
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  get width(): number { return this.image?.naturalWidth ?? 1; }
  get height(): number { return this.image?.naturalHeight ?? 1; }

  setImage(image: HTMLImageElement | null): void {
    const same = image?.naturalWidth === this.width && image.naturalHeight === this.height;
    this.image = image;
    if (!same) this.fit();
    if (image && !this.cursor) this.cursor = [Math.round(this.width / 2), Math.round(this.height / 2)];
    this.draw();
  }

  setVisible(visible: Visible | null): void {
    this.visible = visible;
    this.byLevel = Array.from({ length: LEVELS }, () => []);
    visible?.distance.forEach((distance, i) => this.byLevel[levelOf(distance)]!.push(i));
    this.draw();
  }

  fit(): void {
    this.zoom = Math.min(this.canvas.width / this.width, this.canvas.height / this.height);
    this.left = (this.canvas.width - this.zoom * this.width) / 2;
    this.top = (this.canvas.height - this.zoom * this.height) / 2;
    this.draw();
  }

  /** Zoom about a place of the canvas; about the cursor without one. */
  zoomBy(factor: number, at?: [number, number]): void {
    const [x, y] = at ?? this.toCanvas(this.cursor ?? [this.width / 2, this.height / 2]);
    const least = 0.5 * Math.min(this.canvas.width / this.width, this.canvas.height / this.height);
    const zoom = Math.max(least, Math.min(MAX_ZOOM, this.zoom * factor));
    this.left = x - ((x - this.left) * zoom) / this.zoom;
    this.top = y - ((y - this.top) * zoom) / this.zoom;
    this.zoom = zoom;
    if (!at) this.keepInView(this.cursor);
    this.draw();
  }

  /** Place on the canvas, in its own pixels, of a pixel of the image. */
  toCanvas(pixel: Pixel): [number, number] {
    return [this.left + this.zoom * (pixel[0] + 0.5), this.top + this.zoom * (pixel[1] + 0.5)];
  }

  private toPixel(x: number, y: number): Pixel {
    return [(x - this.left) / this.zoom - 0.5, (y - this.top) / this.zoom - 0.5];
  }

  moveCursor(direction: Direction, step: number): void {
    const [u, v] = this.cursor ?? [this.width / 2, this.height / 2];
    const du = direction === "left" ? -step : direction === "right" ? step : 0;
    const dv = direction === "up" ? -step : direction === "down" ? step : 0;
    this.cursor = [clamp(u + du, -0.5, this.width - 0.5), clamp(v + dv, -0.5, this.height - 0.5)];
    this.keepInView(this.cursor);
    this.draw();
  }

  /** Go to the next projected point in a direction; its row in the cloud, or -1. */
  movePoint(direction: Direction): number {
    const seen = this.visible;
    if (!seen || !seen.rows.length) return -1;
    const now = seen.rows.indexOf(this.chosenRow);
    const from: Pixel = now >= 0
      ? [seen.u[now]!, seen.v[now]!] : this.pending ?? this.cursor ?? [0, 0];
    const found = now >= 0
      ? next(seen.u, seen.v, from[0], from[1], direction)
      : nearest(seen.u, seen.v, from[0], from[1], Infinity);
    if (found < 0) return -1;
    this.keepInView([seen.u[found]!, seen.v[found]!]);
    return seen.rows[found]!;
  }

  draw(): void {
    if (this.queued) return;
    this.queued = true;
    requestAnimationFrame(() => { this.queued = false; this.paint(); });
  }

  private resize(): void {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.round(this.canvas.clientWidth * ratio);
    const height = Math.round(this.canvas.clientHeight * ratio);
    if (width === this.canvas.width && height === this.canvas.height) return;
    this.canvas.width = width;
    this.canvas.height = height;
    this.fit();
  }

  private paint(): void {
    const c = this.context;
    c.fillStyle = "#101418";
    c.fillRect(0, 0, this.canvas.width, this.canvas.height);
    if (!this.image) return;
    c.imageSmoothingEnabled = this.zoom < 2;
    c.globalAlpha = Math.min(1, 2 * (1 - this.blend));
    c.drawImage(this.image, this.left, this.top, this.zoom * this.width, this.zoom * this.height);
    this.paintPoints();
    c.globalAlpha = 1;
    if (this.advice) this.paintAdvice(this.advice);
    for (const one of this.pairs) {
      this.mark(one.pair.pixel_px, one.place === this.selected ? CHOSEN : MARK, String(one.place + 1));
    }
    if (this.pending) this.mark(this.pending, CHOSEN, "");
    if (this.cursor && !this.picksPoints) this.mark(this.cursor, HINT, "");
    this.paintChosen();
    this.paintLoupe();
  }

  private paintPoints(): void {
    const seen = this.visible, c = this.context;
    if (!seen) return;
    c.globalAlpha = Math.min(1, 2 * this.blend);
    const side = Math.max(2, Math.min(8, 1.6 * this.zoom));
    for (let level = LEVELS - 1; level >= 0; level--) {
      c.fillStyle = cssOf(level);
      for (const i of this.byLevel[level]!) {
        const x = this.left + this.zoom * (seen.u[i]! + 0.5);
        const y = this.top + this.zoom * (seen.v[i]! + 0.5);
        if (x > -9 && y > -9 && x < this.canvas.width + 9 && y < this.canvas.height + 9) {
          c.fillRect(x - side / 2, y - side / 2, side, side);
        }
      }
    }
  }

  private paintAdvice(advice: Advice): void {
    const c = this.context, ratio = window.devicePixelRatio || 1;
    const width = (this.zoom * this.width) / 3, height = (this.zoom * this.height) / 3;
    c.strokeStyle = HINT;
    c.lineWidth = 2 * ratio;
    c.setLineDash([8 * ratio, 6 * ratio]);
    c.strokeRect(this.left + advice.column * width, this.top + advice.row * height, width, height);
    c.setLineDash([]);
  }

  private paintChosen(): void {
    const seen = this.visible;
    const place = seen ? seen.rows.indexOf(this.chosenRow) : -1;
    if (!seen || place < 0) return;
    const [x, y] = this.toCanvas([seen.u[place]!, seen.v[place]!]), c = this.context;
    for (const [width, colour] of [[5, MARK_EDGE], [2.5, CHOSEN]] as const) {
      c.beginPath();
      c.arc(x, y, 9 * (window.devicePixelRatio || 1), 0, 2 * Math.PI);
      c.lineWidth = width;
      c.strokeStyle = colour;
      c.stroke();
    }
  }

  private mark(pixel: Pixel, colour: string, label: string): void {
    paintMark(this.context, this.toCanvas(pixel), colour, label);
  }

  private paintLoupe(): void {
    paintLoupe(this.loupe, this.image, this.hover ?? this.pending ?? this.cursor);
  }

  private place(event: PointerEvent | WheelEvent): [number, number] {
    const box = this.canvas.getBoundingClientRect(), ratio = this.canvas.width / box.width;
    return [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
  }

  private down(event: PointerEvent): void {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, this.place(event));
    this.moved = this.pointers.size > 1 ? Infinity : 0;
    this.pinch = 0;
  }

  private move(event: PointerEvent): void {
    const [x, y] = this.place(event), before = this.pointers.get(event.pointerId);
    this.hover = this.toPixel(x, y);
    if (before) {
      this.moved += Math.hypot(x - before[0], y - before[1]);
      this.pointers.set(event.pointerId, [x, y]);
      if (this.pointers.size === 2) this.pinchZoom();
      else if (this.moved > CLICK_PX) { this.left += x - before[0]; this.top += y - before[1]; }
    }
    this.draw();
  }

  private pinchZoom(): void {
    const [a, b] = [...this.pointers.values()] as [[number, number], [number, number]];
    const apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
    if (this.pinch) this.zoomBy(apart / this.pinch, [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]);
    this.pinch = apart;
  }

  private up(event: PointerEvent): void {
    const wasDown = this.pointers.delete(event.pointerId);
    if (!wasDown || this.moved > CLICK_PX) return;
    const [x, y] = this.place(event);
    if (this.picksPoints) this.pickPoint(x, y);
    else this.pickPixel(this.toPixel(x, y));
  }

  private pickPixel(pixel: Pixel): void {
    if (pixel[0] < -0.5 || pixel[1] < -0.5 || pixel[0] > this.width - 0.5 || pixel[1] > this.height - 0.5) return;
    this.cursor = pixel;
    this.events.pixel(pixel);
  }

  private pickPoint(x: number, y: number): void {
    const seen = this.visible;
    if (!seen) return;
    const [u, v] = this.toPixel(x, y), reach = (REACH_PX * (window.devicePixelRatio || 1)) / this.zoom;
    const found = nearest(seen.u, seen.v, u, v, reach);
    if (found >= 0) this.events.point(seen.rows[found]!);
  }

  private wheel(event: WheelEvent): void {
    event.preventDefault();
    this.zoomBy(Math.exp(-event.deltaY / 400), this.place(event));
  }

  private keepInView(pixel: Pixel | null): void {
    if (!pixel) return;
    const [x, y] = this.toCanvas(pixel), margin = 30;
    this.left += clamp(x, margin, this.canvas.width - margin) - x;
    this.top += clamp(y, margin, this.canvas.height - margin) - y;
  }
}

const clamp = (value: number, low: number, high: number) => Math.max(low, Math.min(high, value));
