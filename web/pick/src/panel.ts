// The estimate and the table of pairs, as text.

import type { CameraEstimate, Estimate, Pair, PairResult, Session } from "./api";

export interface PanelEvents {
  select(place: number): void;
  use(place: number, used: boolean): void;
  remove(place: number): void;
}

export function element<K extends keyof HTMLElementTagNameMap>(
  tag: K, text = "", className = "",
): HTMLElementTagNameMap[K] {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

const fixed = (value: number | null, digits: number): string => (value === null ? "–" : value.toFixed(digits));

export function showEstimate(into: HTMLElement, estimate: Estimate | null, camera: string): void {
  into.replaceChildren();
  const found = estimate?.cameras.find((one) => one.camera === camera);
  if (!found) return;
  const list = element("dl");
  for (const [term, value] of facts(found, estimate!)) list.append(element("dt", term), element("dd", value));
  into.append(list);
  for (const warning of found.warnings) into.append(element("p", warning, "warning"));
  if (estimate?.advice) into.append(element("p", `Next: ${estimate.advice.words}.`, "advice"));
  if (found.solvers.length) into.append(solverTable(found));
}

function facts(found: CameraEstimate, estimate: Estimate): [string, string][] {
  const rows: [string, string][] = [["Pairs used", String(found.pairs_used)]];
  if (found.rms_px === null) return rows;
  rows.push(["Residual", `${found.rms_px.toFixed(2)} px, root mean square`]);
  rows.push(["Picking error", `${fixed(estimate.scale, 2)} times the stated one`]);
  if (found.sigma_deg && found.sigma_cm) {
    rows.push(["1 sigma about x, y, z", `${found.sigma_deg.map((s) => s.toFixed(3)).join("  ")} deg`]);
    rows.push(["1 sigma along x, y, z", `${found.sigma_cm.map((s) => s.toFixed(2)).join("  ")} cm`]);
  }
  if (found.weakest) rows.push(["Weakest direction", found.weakest]);
  return rows;
}

function solverTable(found: CameraEstimate): HTMLElement {
  const details = element("details");
  const apart = `${fixed(found.spread_deg, 2)} deg, ${fixed(found.spread_cm, 1)} cm`;
  details.append(element("summary", `PnP solvers: up to ${apart} from the joint solve`));
  const rows = found.solvers.map((one) => [
    one.solver, one.median_px.toFixed(2), one.rotation_deg.toFixed(3), one.distance_cm.toFixed(1),
  ]);
  details.append(table(["solver", "median px", "deg", "cm"], rows));
  return details;
}

function table(heads: string[], rows: string[][]): HTMLTableElement {
  const made = element("table");
  const head = made.createTHead().insertRow();
  for (const text of heads) { const cell = element("th", text); cell.scope = "col"; head.append(cell); }
  const body = made.createTBody();
  for (const row of rows) { const line = body.insertRow(); for (const text of row) line.append(element("td", text)); }
  return made;
}

const HEADS = ["pair", "frame", "camera", "residual px", "without it: deg", "cm", "use", ""];

export function showPairs(
  into: HTMLElement, session: Session, estimate: Estimate | null, selected: number, events: PanelEvents,
): void {
  const focused = document.activeElement?.getAttribute("data-key");
  const results = new Map(
    estimate?.revision === session.revision
      ? estimate.cameras.flatMap((one) => one.pairs.map((pair) => [pair.place, pair] as const)) : [],
  );
  into.replaceChildren();
  if (!session.pairs.length) return;
  const made = table(HEADS, []);
  made.tHead!.rows[0]!.cells[7]!.append(element("span", "remove", "hidden"));
  session.pairs.forEach((pair, place) => {
    made.tBodies[0]!.append(pairRow(session, pair, place, results.get(place), place === selected, events));
  });
  into.append(made);
  if (focused) into.querySelector<HTMLElement>(`[data-key="${focused}"]`)?.focus();
}

function pairRow(
  session: Session, pair: Pair, place: number, result: PairResult | undefined, selected: boolean,
  events: PanelEvents,
): HTMLTableRowElement {
  const row = element("tr", "", [selected && "selected", result?.suspicious && "suspicious"].filter(Boolean).join(" "));
  const go = button(String(place + 1), `Show pair ${place + 1}`, `go${place}`, () => events.select(place));
  const frame = session.frames.find((one) => one.index === pair.frame)?.name ?? String(pair.frame);
  const residual = result ? Math.hypot(...result.residual_px).toFixed(2) : "–";
  const use = element("input");
  use.type = "checkbox";
  use.checked = pair.used;
  use.setAttribute("aria-label", `Use pair ${place + 1}`);
  use.setAttribute("data-key", `use${place}`);
  use.addEventListener("change", () => events.use(place, use.checked));
  const cells: (string | HTMLElement)[] = [
    go, frame, pair.camera, residual, fixed(result?.moves_deg ?? null, 3), fixed(result?.moves_cm ?? null, 1), use,
    button("✕", `Remove pair ${place + 1}`, `remove${place}`, () => events.remove(place)),
  ];
  for (const cell of cells) { const td = element("td"); td.append(cell); row.append(td); }
  return row;
}

function button(text: string, label: string, key: string, act: () => void): HTMLButtonElement {
  const made = element("button", text);
  made.type = "button";
  made.setAttribute("aria-label", label);
  made.setAttribute("data-key", key);
  made.addEventListener("click", act);
  return made;
}
