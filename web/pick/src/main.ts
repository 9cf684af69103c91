// The page: one state, what changes it, and the views that show it.

import * as api from "./api";
import type { Estimate, Pixel, Pose, Session } from "./api";
import { CloudView } from "./cloudView";
import { ImageView } from "./imageView";
import { DIRECTIONS, HELP, onKey } from "./keys";
import { element, showEstimate, showPairs } from "./panel";

const byId = <T extends HTMLElement>(id: string): T => document.getElementById(id) as T;
const frames = byId<HTMLSelectElement>("frame"), cameras = byId<HTMLSelectElement>("camera");
const blend = byId<HTMLInputElement>("blend"), snap = byId<HTMLInputElement>("snap");
const pose = byId<HTMLSelectElement>("pose"), source = byId<HTMLSelectElement>("source");
const status = byId("status"), problem = byId("problem");

let session: Session;
let estimate: Estimate | null = null;
let selected = -1;
let shownPose: Pose = "guess";
let busy: Promise<void> = Promise.resolve();
let shown = 0; // counts what is shown, so that late answers for an earlier frame are dropped

const image = new ImageView(byId<HTMLCanvasElement>("image"), byId<HTMLCanvasElement>("loupe"), {
  pixel: (pixel) => enqueue(() => takePixel(pixel)),
  point: (row) => enqueue(() => takePoint(row)),
});
const cloud = new CloudView(byId<HTMLCanvasElement>("cloud"), (row) => enqueue(() => takePoint(row)));

/** One change after the other, so that none is made of an old session. */
function enqueue(work: () => Promise<void> | void): void {
  busy = busy.then(work).then(
    () => { problem.textContent = ""; },
    (error: unknown) => { problem.textContent = error instanceof Error ? error.message : String(error); },
  ).then(tell);
}

const frame = (): number => Number(frames.value);
const camera = (): string => cameras.value;

async function takePixel(pixel: Pixel): Promise<void> {
  image.pending = snap.checked ? (await api.getCorner(frame(), camera(), pixel)) ?? pixel : pixel;
  image.cursor = image.pending;
  if (image.chosenRow >= 0) return makePair();
  image.picksPoints = source.value === "image";
  image.draw();
}

async function takePoint(row: number): Promise<void> {
  choose(row);
  if (image.pending) await makePair();
}

function choose(row: number): void {
  image.chosenRow = row;
  cloud.setChosen(row);
  image.draw();
}

async function makePair(): Promise<void> {
  const pixel = image.pending, row = image.chosenRow;
  if (!pixel || row < 0) return;
  session = await api.addPair(session.revision, frame(), camera(), pixel, row);
  selected = session.pairs.length - 1;
  drop();
  await refresh();
}

function drop(): void {
  image.pending = null;
  image.picksPoints = false;
  choose(-1);
}

async function edit(change: Promise<Session>): Promise<void> {
  session = await change;
  selected = Math.min(selected, session.pairs.length - 1);
  await refresh();
}

/** What depends on the pairs: the table, the estimate, the points at the estimate. */
async function refresh(): Promise<void> {
  showSession();
  const first = !hasEstimate();
  estimate = await api.getEstimate(frame(), camera());
  if (first && hasEstimate()) pose.value = "estimate";
  showSession();
  await showPoints();
}

const hasEstimate = (): boolean =>
  !!estimate?.cameras.some((one) => one.camera === camera() && one.T_camera_lidar);

function showSession(): void {
  const suspicious = new Set(
    estimate?.cameras.flatMap((one) => one.pairs.filter((p) => p.suspicious).map((p) => p.place)),
  );
  const here = session.pairs.map((pair, place) => ({ place, pair, suspicious: suspicious.has(place) }))
    .filter((one) => one.pair.frame === frame());
  image.pairs = here.filter((one) => one.pair.camera === camera());
  image.selected = selected;
  image.advice = estimate?.revision === session.revision ? estimate.advice : null;
  image.draw();
  cloud.setPicked(here.map((one) => one.pair));
  showEstimate(byId("estimate"), estimate, camera());
  showPairs(byId("pairs"), session, estimate, selected, {
    select: (place) => enqueue(() => show(place)),
    use: (place, used) => enqueue(() => edit(api.changePair(session.revision, place, { used }))),
    remove: (place) => enqueue(() => edit(api.removePair(session.revision, place))),
  });
  byId<HTMLButtonElement>("undo").disabled = !session.can_undo;
  byId<HTMLButtonElement>("redo").disabled = !session.can_redo;
}

async function showPoints(): Promise<void> {
  shownPose = pose.value === "estimate" && hasEstimate() ? "estimate" : "guess";
  const now = shown, seen = await api.getVisible(frame(), camera(), shownPose);
  if (now === shown) image.setVisible(seen);
}

/** Show the chosen frame and camera. */
async function showFrame(): Promise<void> {
  const now = ++shown;
  drop();
  const picture = new Image();
  picture.src = api.imageAddress(frame(), camera());
  const [points] = await Promise.all([api.getCloud(frame()), picture.decode()]);
  if (now !== shown) return;
  image.setImage(picture);
  cloud.setCloud(points);
  await refresh();
}

async function show(place: number): Promise<void> {
  const pair = session.pairs[place];
  if (!pair) return;
  selected = place;
  frames.value = String(pair.frame);
  offerCameras();
  cameras.value = pair.camera;
  await showFrame();
  image.cursor = pair.pixel_px;
  choose(pair.point_index);
}

function offerCameras(): void {
  const before = cameras.value;
  const given = session.frames.find((one) => one.index === frame())?.cameras ?? [];
  cameras.replaceChildren(...session.cameras.filter((one) => given.includes(one.name)).map((one) => option(one.name, one.name)));
  if (given.includes(before)) cameras.value = before;
}

function option(value: string, text: string): HTMLOptionElement {
  const made = element("option", text);
  made.value = value;
  return made;
}

function step(select: HTMLSelectElement, by: number): void {
  const count = select.options.length;
  select.selectedIndex = (select.selectedIndex + by + count) % count;
  select.dispatchEvent(new Event("change"));
}

async function snapNow(): Promise<void> {
  const from = image.pending ?? image.cursor;
  const corner = from && (await api.getCorner(frame(), camera(), from));
  if (!corner) throw new Error("no corner within 8 pixels");
  image.cursor = corner;
  if (image.pending) image.pending = corner;
  image.draw();
}

async function write(): Promise<void> {
  const written = await api.writeReference();
  byId("written").textContent = `Written: ${written.files.join(", ")} (${written.cameras.join(", ")}).`;
}

/** The status line: what comes next. */
function tell(): void {
  const last = session?.pairs.length ? `Pair ${session.pairs.length} saved. ` : "";
  status.textContent = image.pending
    ? `Pixel ${image.pending.map((value) => value.toFixed(1)).join(", ")}: now its point, in the ${source.value}.`
    : image.chosenRow >= 0 ? "Point chosen: now its pixel, in the image." : `${last}Click a pixel in the image.`;
}

function imageKey(event: KeyboardEvent): void {
  const direction = DIRECTIONS[event.key];
  if (direction) {
    event.preventDefault();
    if (image.picksPoints) { const row = image.movePoint(direction); if (row >= 0) choose(row); }
    else image.moveCursor(direction, event.shiftKey ? 10 : event.altKey ? 0.1 : 1);
  } else if (event.key === "Enter") {
    event.preventDefault();
    if (image.picksPoints) { if (image.chosenRow >= 0) enqueue(makePair); }
    else if (image.cursor) {
      const pixel = image.cursor;
      enqueue(async () => { await takePixel(pixel); if (image.pending && source.value === "cloud") cloud.canvas.focus(); });
    }
  } else {
    onKey(event, { "+": () => image.zoomBy(1.5), "-": () => image.zoomBy(1 / 1.5), "0": () => image.fit() });
  }
}

function cloudKey(event: KeyboardEvent): void {
  const direction = DIRECTIONS[event.key];
  if (direction) {
    event.preventDefault();
    if (event.shiftKey) cloud.orbit(direction);
    else { const row = cloud.movePoint(direction, image.chosenRow); if (row >= 0) choose(row); }
  } else if (event.key === "Enter") {
    event.preventDefault();
    if (image.chosenRow >= 0) enqueue(async () => { await takePoint(image.chosenRow); image.canvas.focus(); });
  } else {
    onKey(event, {
      "+": () => cloud.zoomBy(1.3), "-": () => cloud.zoomBy(1 / 1.3), "0": () => cloud.reset(), v: lookFromCamera,
    });
  }
}

function lookFromCamera(): void {
  const found = estimate?.cameras.find((one) => one.camera === camera())?.T_camera_lidar;
  if (found) cloud.lookFrom(found);
  else problem.textContent = "there is no estimate of this camera yet";
}

function setBlend(by: number): void {
  blend.valueAsNumber += by;
  blend.dispatchEvent(new Event("input"));
}

const ACTIONS: Record<string, () => void> = {
  u: () => enqueue(() => edit(api.undo(session.revision))),
  r: () => enqueue(() => edit(api.redo(session.revision))),
  k: () => enqueue(snapNow),
  s: () => enqueue(write),
  n: () => step(frames, 1),
  p: () => step(frames, -1),
  c: () => step(cameras, 1),
  e: () => step(pose, 1),
  m: () => step(source, 1),
  "[": () => setBlend(-10),
  "]": () => setBlend(10),
  escape: () => enqueue(drop),
  "?": () => byId<HTMLDialogElement>("help").showModal(),
};

function listen(): void {
  frames.addEventListener("change", () => { offerCameras(); enqueue(showFrame); });
  cameras.addEventListener("change", () => { image.cursor = null; enqueue(showFrame); });
  pose.addEventListener("change", () => enqueue(showPoints));
  source.addEventListener("change", () => { image.picksPoints = !!image.pending && source.value === "image"; image.draw(); enqueue(() => undefined); });
  blend.addEventListener("input", () => { image.blend = blend.valueAsNumber / 100; image.draw(); });
  image.canvas.addEventListener("keydown", imageKey);
  cloud.canvas.addEventListener("keydown", cloudKey);
  document.addEventListener("keydown", (event) => { if (!event.defaultPrevented && !byId<HTMLDialogElement>("help").open) onKey(event, ACTIONS); });
  for (const [id, key] of [["undo", "u"], ["redo", "r"], ["write", "s"], ["corner", "k"], ["drop", "escape"], ["keys", "?"]] as const) {
    byId(id).addEventListener("click", ACTIONS[key]!);
  }
  byId("view").addEventListener("click", lookFromCamera);
  byId("side").addEventListener("click", () => cloud.reset());
  image.canvas.addEventListener("pointermove", (event) => {
    const box = image.canvas.getBoundingClientRect();
    image.loupe.classList.toggle("left", event.clientX > box.left + box.width / 2);
  });
}

function fillHelp(): void {
  for (const [key, meaning] of HELP) byId("keylist").append(element("dt", key), element("dd", meaning));
}

async function start(): Promise<void> {
  session = await api.getSession();
  frames.replaceChildren(...session.frames.map((one) => option(String(one.index), one.name)));
  offerCameras();
  fillHelp();
  listen();
  await showFrame();
}

enqueue(start);

// For scripts that drive the page: where a pixel and a point are on it, and when it is at rest.
Object.assign(window, {
  calibgraphPick: {
    imagePlace: (pixel: Pixel): [number, number] => {
      const box = image.canvas.getBoundingClientRect(), ratio = image.canvas.width / box.width;
      const [x, y] = image.toCanvas(pixel);
      return [box.left + x / ratio, box.top + y / ratio];
    },
    cloudPlace: (row: number) => cloud.placeOf(row),
    rest: () => busy.then(() => new Promise((done) => requestAnimationFrame(() => done(session.revision)))),
  },
});
