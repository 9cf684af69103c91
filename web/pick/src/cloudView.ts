// The cloud in 3-D: orbit, zoom, and the point under the pointer. Axes of the LiDAR: x ahead, z up.

import {
  BufferAttribute, BufferGeometry, Color, PerspectiveCamera, Points, PointsMaterial, Scene,
  Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { Pair } from "./api";
import { levelOf, rgbOf } from "./colours";
import { nearest, next, type Direction } from "./nearest";

const CLICK_PX = 4, REACH_PX = 14, FRONT_PX = 1.5, FAR_M = 400, POINT_PX = 2.4;
const NEW = new Color("#ff40ff"), PICKED = new Color("#ffffff");

interface OnScreen { x: Float32Array; y: Float32Array; depth: Float32Array; rows: Uint32Array }

export class CloudView {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(60, 1, 0.1, FAR_M);
  private readonly controls: OrbitControls;
  private readonly points = new Points(
    new BufferGeometry(), new PointsMaterial({ size: POINT_PX, sizeAttenuation: false, vertexColors: true }),
  );
  private readonly picked = marks(10, PICKED);
  private readonly chosen = marks(14, NEW);
  private cloud: Float32Array = new Float32Array();
  private screen: OnScreen | null = null;
  private queued = false;
  private moved = 0;
  private down: [number, number] | null = null;

  constructor(readonly canvas: HTMLCanvasElement, private readonly pick: (row: number) => void) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true });
    this.scene.background = new Color("#101418");
    this.scene.add(this.points, this.picked, this.chosen);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("change", () => this.draw());
    this.reset();
    canvas.addEventListener("pointerdown", (event) => { this.moved = 0; this.down = [event.clientX, event.clientY]; });
    canvas.addEventListener("pointermove", (event) => this.track(event));
    canvas.addEventListener("pointerup", (event) => this.up(event));
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  /** Look along x from behind and above the LiDAR. */
  reset(): void {
    this.camera.position.set(-6, 0, 4);
    this.controls.target.set(8, 0, 0);
    this.controls.update();
    this.draw();
  }

  /** Look from a camera's centre along its axis, as it sees the scene. */
  lookFrom(T_camera_lidar: number[][]): void {
    const [x, y, z] = T_camera_lidar as [number[], number[], number[]];
    const axis = (column: number) => new Vector3(x[column], y[column], z[column]);
    const t = axis(3), centre = new Vector3(-axis(0).dot(t), -axis(1).dot(t), -axis(2).dot(t));
    this.camera.position.copy(centre);
    this.controls.target.copy(centre).add(new Vector3(z[0], z[1], z[2]).multiplyScalar(6));
    this.controls.update();
    this.draw();
  }

  setCloud(cloud: Float32Array): void {
    this.cloud = cloud;
    const count = cloud.length / 4;
    const places = new Float32Array(3 * count), colours = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) {
      const x = cloud[4 * i]!, y = cloud[4 * i + 1]!, z = cloud[4 * i + 2]!;
      places.set([x, y, z], 3 * i);
      colours.set(rgbOf(levelOf(Math.hypot(x, y, z))), 3 * i);
    }
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(places, 3));
    geometry.setAttribute("color", new BufferAttribute(colours, 3));
    this.points.geometry.dispose();
    this.points.geometry = geometry;
    this.draw();
  }

  setPicked(pairs: Pair[]): void {
    setMarks(this.picked, pairs.map((pair) => pair.point_lidar_m));
    this.draw();
  }

  setChosen(row: number): void {
    const at = (axis: number) => this.cloud[4 * row + axis] ?? 0;
    setMarks(this.chosen, row < 0 ? [] : [[at(0), at(1), at(2)]]);
    this.draw();
  }

  orbit(direction: Direction): void {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const turn = direction === "left" ? 0.1 : direction === "right" ? -0.1 : 0;
    offset.applyAxisAngle(new Vector3(0, 0, 1), turn);
    const tilt = direction === "up" ? 0.08 : direction === "down" ? -0.08 : 0;
    const level = new Vector3(-offset.y, offset.x, 0).normalize();
    const tilted = offset.clone().applyAxisAngle(level, -tilt);
    if (Math.hypot(tilted.x, tilted.y) > 0.1 * tilted.length()) offset.copy(tilted);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
  }

  zoomBy(factor: number): void {
    const offset = this.camera.position.clone().sub(this.controls.target).divideScalar(factor);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
  }

  /** The next point in a direction from a row, as seen now; the one nearest the middle from -1. */
  movePoint(direction: Direction, row: number): number {
    const { x, y, rows } = this.onScreen();
    const now = row < 0 ? -1 : rows.indexOf(row);
    const box = this.canvas.getBoundingClientRect();
    const found = now < 0
      ? nearest(x, y, box.width / 2, box.height / 2, Infinity)
      : next(x, y, x[now]!, y[now]!, direction);
    return found < 0 ? -1 : rows[found]!;
  }

  /** Place of a point on the page, for tests and the tour. */
  placeOf(row: number): [number, number] {
    const at = new Vector3(this.cloud[4 * row], this.cloud[4 * row + 1], this.cloud[4 * row + 2]);
    at.project(this.camera);
    const box = this.canvas.getBoundingClientRect();
    return [box.left + ((at.x + 1) / 2) * box.width, box.top + ((1 - at.y) / 2) * box.height];
  }

  private draw(): void {
    this.screen = null;
    if (this.queued) return;
    this.queued = true;
    requestAnimationFrame(() => { this.queued = false; this.renderer.render(this.scene, this.camera); });
  }

  private resize(): void {
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    if (!width || !height) return;
    this.renderer.setPixelRatio(window.devicePixelRatio || 1);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  /** Places of all points in front of the eye, in CSS pixels of the canvas. */
  private onScreen(): OnScreen {
    if (this.screen) return this.screen;
    this.camera.updateMatrixWorld();
    const m = this.camera.projectionMatrix.clone().multiply(this.camera.matrixWorldInverse).elements;
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    const count = this.cloud.length / 4;
    const xs = new Float32Array(count), ys = new Float32Array(count), depths = new Float32Array(count);
    const rows = new Uint32Array(count);
    let kept = 0;
    for (let i = 0; i < count; i++) {
      const x = this.cloud[4 * i]!, y = this.cloud[4 * i + 1]!, z = this.cloud[4 * i + 2]!;
      const w = m[3]! * x + m[7]! * y + m[11]! * z + m[15]!;
      if (w < 0.1) continue;
      const px = (m[0]! * x + m[4]! * y + m[8]! * z + m[12]!) / w;
      const py = (m[1]! * x + m[5]! * y + m[9]! * z + m[13]!) / w;
      if (Math.abs(px) > 1 || Math.abs(py) > 1) continue;
      xs[kept] = ((px + 1) / 2) * width;
      ys[kept] = ((1 - py) / 2) * height;
      depths[kept] = w;
      rows[kept++] = i;
    }
    const [x, y, depth] = [xs, ys, depths].map((each) => each.subarray(0, kept)) as [Float32Array, Float32Array, Float32Array];
    this.screen = { x, y, depth, rows: rows.subarray(0, kept) };
    return this.screen;
  }

  /** The point at a place of the canvas: of those about equally near to it, the foremost; or -1. */
  private rowAt(px: number, py: number): number {
    const { x, y, depth, rows } = this.onScreen();
    let found = nearest(x, y, px, py, REACH_PX);
    if (found < 0) return -1;
    const reach = Math.hypot(x[found]! - px, y[found]! - py) + FRONT_PX;
    for (let i = 0; i < rows.length; i++) {
      if (depth[i]! < depth[found]! && Math.hypot(x[i]! - px, y[i]! - py) <= reach) found = i;
    }
    return rows[found]!;
  }

  private track(event: PointerEvent): void {
    if (!this.down) return;
    this.moved = Math.max(this.moved, Math.hypot(event.clientX - this.down[0], event.clientY - this.down[1]));
  }

  private up(event: PointerEvent): void {
    const clicked = this.down && this.moved <= CLICK_PX;
    this.down = null;
    if (!clicked) return;
    const box = this.canvas.getBoundingClientRect();
    const row = this.rowAt(event.clientX - box.left, event.clientY - box.top);
    if (row >= 0) this.pick(row);
  }
}

function marks(size: number, colour: Color): Points {
  const material = new PointsMaterial({ size, sizeAttenuation: false, color: colour, depthTest: false });
  const made = new Points(new BufferGeometry(), material);
  made.renderOrder = 1;
  made.frustumCulled = false;
  return made;
}

function setMarks(points: Points, places: (readonly [number, number, number])[]): void {
  points.geometry.dispose();
  points.geometry = new BufferGeometry();
  points.geometry.setAttribute("position", new BufferAttribute(new Float32Array(places.flat()), 3));
}
