// The session: what is shown, what is picked, what the pairs give.

import { Panorama, RAINBOW, place } from "./panorama.js";
import { View, line, mark } from "./view.js";

const $ = (id) => document.getElementById(id);
const PENDING = "#ffd400", PICKED = "#00e5ff", WRONG = "#ff5252";
const state = { pairs: [], estimates: {}, pixel: null, point: null, busy: 0 };
let panorama = null, image = null, projected = null;

async function ask(path, options = {}) {
  const response = await fetch(path, options);
  if (response.ok) return response;
  throw new Error((await response.json().catch(() => ({}))).error ?? response.statusText);
}

const json = async (path, options) => (await ask(path, options)).json();
const floats = async (path) => new Float32Array(await (await ask(path)).arrayBuffer());
const post = (path, body) => json(path, { method: "POST", body: JSON.stringify(body ?? {}) });

// Do one thing after another; an error is shown and leaves everything as it was.
let last = Promise.resolve();
function work(task) {
  state.busy++;
  last = last.then(task).catch((error) => say(error.message)).finally(() => { state.busy--; });
  return last;
}

function say(text) { $("status").textContent = text; }
const camera = () => $("camera").value;
const frame = () => Number($("frame").value);
const numbered = () => state.pairs.map((pair, i) => ({ ...pair, number: i + 1 }));
const here = (pair) => pair.camera === camera() && pair.frame === frame();

const imageView = new View($("image"), {
  draw(context, view) {
    if (!image) return;
    context.imageSmoothingEnabled = view.scale < 2;
    // Pixel (0, 0) is the centre of the first one.
    context.drawImage(image, ...view.toScreen(-0.5, -0.5), image.width * view.scale, image.height * view.scale);
    if (projected && $("points").checked) drawProjected(context, view);
    for (const pair of numbered().filter(here)) {
      const one = residual(pair);
      const at = view.toScreen(...pair.pixel_px);
      if (one.px) {
        context.strokeStyle = one.wrong ? WRONG : PICKED;
        line(context, at, view.toScreen(pair.pixel_px[0] + one.px[0], pair.pixel_px[1] + one.px[1]));
      }
      mark(context, at, String(pair.number), one.wrong ? WRONG : PICKED);
    }
    if (state.pixel) mark(context, view.toScreen(...state.pixel), "?", PENDING);
  },
  pick(x, y) {
    if (!image || x < -0.5 || y < -0.5 || x > image.width - 0.5 || y > image.height - 0.5) return;
    state.pixel = [x, y];
    complete();
  },
});

const cloudView = new View($("cloud"), {
  draw(context, view) {
    if (!panorama) return;
    panorama.draw(context, view, $("colour").value);
    const T = state.cameras[camera()].T_camera_lidar;
    for (const pair of numbered().filter(here)) {
      mark(context, view.toScreen(...place(T, ...pair.point_lidar_m)), String(pair.number), residual(pair).wrong ? WRONG : PICKED);
    }
    if (state.point) mark(context, view.toScreen(...place(T, ...state.point)), "?", PENDING);
  },
  pick(x, y) {
    const found = panorama?.nearest(cloudView, x, y);
    if (!found) return say("No point is there: zoom in, or click nearer to one.");
    state.point = found;
    complete();
  },
});

function drawProjected(context, view) {
  const dot = Math.max(2, Math.min(view.scale * 1.5, 5));
  for (let i = 0; i < projected.length; i += 3) {
    const [x, y] = view.toScreen(projected[i], projected[i + 1]);
    const share = Math.min(1, Math.max(0, Math.log(projected[i + 2] / 3) / Math.log(15)));
    context.fillStyle = RAINBOW[(share * 63) | 0];
    context.fillRect(x - dot / 2, y - dot / 2, dot, dot);
  }
}

// The residual of a pair: projected minus picked, and whether it contradicts the others.
function residual(pair) {
  const of = state.pairs.filter((other) => other.camera === pair.camera);
  const estimate = state.estimates[pair.camera];
  const row = of.indexOf(state.pairs[pair.number - 1]);
  return { px: estimate?.residuals_px[row] ?? null, wrong: estimate?.wrong[row] ?? false };
}

function complete() {
  if (state.pixel && state.point) {
    const pair = { frame: frame(), camera: camera(), pixel_px: state.pixel, point_lidar_m: state.point };
    state.pixel = state.point = null;
    change((pairs) => [...pairs, pair]);
  } else say(state.pixel ? "Now click the same place in the cloud." : "Now click the same place in the image.");
  redraw();
}

function change(make) {
  return work(async () => {
    update(await post("pairs", make(state.pairs)));
    say("Saved.");
    await project();
  });
}

function update(found) {
  Object.assign(state, found);
  const rows = numbered().filter((pair) => pair.camera === camera()).map((pair) => {
    const row = document.createElement("tr"), { px, wrong } = residual(pair);
    row.className = wrong ? "wrong" : here(pair) ? "" : "elsewhere";
    const distance = Math.hypot(...pair.point_lidar_m);
    const texts = [pair.number, pair.frame, pair.pixel_px.map((x) => x.toFixed(1)).join(", "),
      `${distance.toFixed(1)} m`, px ? `${Math.hypot(...px).toFixed(1)} px${wrong ? ", contradicts the others" : ""}` : "not seen"];
    for (const text of texts) row.insertCell().textContent = text;
    const button = document.createElement("button");
    button.textContent = "Remove";
    button.setAttribute("aria-label", `Remove pair ${pair.number}`);
    button.onclick = () => change((pairs) => pairs.filter((_, i) => i !== pair.number - 1));
    row.insertCell().append(button);
    return row;
  });
  $("pairs").replaceChildren(...rows);
  $("estimate").textContent = describe(state.estimates[camera()]);
  redraw();
}

function describe(estimate) {
  if (!estimate) return "No pairs of this camera yet; six are needed.";
  if (estimate.problem) return `${estimate.problem}. Residuals are those of the guess.`;
  const sizes = estimate.residuals_px.filter(Boolean).map((px) => Math.hypot(...px)).sort((a, b) => a - b);
  const axes = (values, digits) => values.map((x) => x.toFixed(digits)).join(", ");
  const bar = estimate.sigma_deg === null ? "The pairs leave a direction free."
    : `1 sigma about and along x, y, z: ${axes(estimate.sigma_deg, 3)} deg; ${axes(estimate.sigma_cm, 1)} cm.`;
  return `Median residual: ${(sizes[sizes.length >> 1] ?? NaN).toFixed(2)} px. ${bar}`;
}

function redraw() {
  imageView.redraw();
  cloudView.redraw();
}

async function project() {
  projected = await floats(`projected/${frame()}/${encodeURIComponent(camera())}`);
  redraw();
}

// Load the image and the cloud that are chosen.
function load() {
  return work(async () => {
    say("Loading.");
    state.pixel = state.point = null;
    const name = camera();
    const [blob, cloud] = await Promise.all([
      ask(`image/${frame()}/${encodeURIComponent(name)}`).then((response) => response.blob()),
      floats(`cloud/${frame()}`),
    ]);
    image = await createImageBitmap(blob);
    const { T_camera_lidar: T, width_px, height_px } = state.cameras[name];
    panorama = new Panorama(cloud, T);
    imageView.show([width_px - 1, height_px - 1]);
    // The panorama begins where the camera looks by the guess.
    cloudView.show([3600, 1800], [1800, 900], Math.max(0.2, $("cloud").clientWidth / 1000));
    update(state);
    await project();
    say("Click a pixel and the point at the same place.");
  });
}

function fill(select, options) {
  select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
}

function fillFrames() {
  const before = $("frame").value;
  const seen = state.frames.filter((one) => one.cameras.includes(camera()));
  fill($("frame"), seen.map((one) => [one.index, one.name]));
  if (seen.some((one) => String(one.index) === before)) $("frame").value = before;
}

$("camera").onchange = () => { fillFrames(); load(); };
$("frame").onchange = load;
$("colour").onchange = $("points").onchange = redraw;
$("undo").onclick = () => change((pairs) => pairs.slice(0, -1));
$("write").onclick = () => work(async () => {
  say(`Written: ${(await post("write")).files.join(", ")}`);
});
addEventListener("keydown", (event) => {
  if (event.key !== "Escape") return;
  state.pixel = state.point = null;
  redraw();
});

work(async () => {
  Object.assign(state, await json("session"));
  fill($("camera"), Object.keys(state.cameras).map((name) => [name, name]));
  fillFrames();
}).then(load);

// For tests: the places of the screen, and the end of all work.
globalThis.calibgraphPick = {
  imagePlace: (x, y) => imageView.toScreen(x, y),
  cloudPlace: (x, y, z) => cloudView.toScreen(...place(state.cameras[camera()].T_camera_lidar, x, y, z)),
  rest: async () => { while (state.busy) await last; },
};
