// What the server answers, and how it is called. The types are those of answers.py.

export interface Camera { name: string; width_px: number; height_px: number }
export interface Frame { index: number; name: string; cameras: string[] }
export type Pixel = [number, number];
export interface Pair {
  frame: number; camera: string; pixel_px: Pixel; point_index: number;
  point_lidar_m: [number, number, number]; sigma_px: number; used: boolean;
}
export interface Session {
  cameras: Camera[]; frames: Frame[]; revision: number; pairs: Pair[];
  can_undo: boolean; can_redo: boolean;
}
export interface Solver { solver: string; median_px: number; rotation_deg: number; distance_cm: number }
export interface PairResult {
  place: number; residual_px: Pixel; moves_deg: number | null; moves_cm: number | null;
  suspicious: boolean;
}
export interface CameraEstimate {
  camera: string; pairs_used: number; T_camera_lidar: number[][] | null;
  sigma_deg: number[] | null; sigma_cm: number[] | null; rms_px: number | null;
  spread_deg: number | null; spread_cm: number | null;
  solvers: Solver[]; pairs: PairResult[]; warnings: string[]; weakest: string;
}
export interface Advice { words: string; column: number; row: number }
export interface Estimate {
  revision: number; scale: number | null; cameras: CameraEstimate[]; advice: Advice | null;
}
export type Pose = "guess" | "estimate";

/** The points that a camera sees: row in the cloud, pixel, distance from the camera. */
export interface Visible {
  rows: Uint32Array; u: Float32Array; v: Float32Array; distance: Float32Array;
}

const BASE = "/v1/pick";

async function answerOf(path: string, init?: RequestInit): Promise<Response> {
  const answer = await fetch(BASE + path, init);
  if (answer.ok) return answer;
  const problem = (await answer.json().catch(() => ({}))) as { detail?: string };
  throw new Error(problem.detail ?? `the server answered ${answer.status}`);
}

async function getJson<T>(path: string): Promise<T> {
  return (await answerOf(path)).json() as Promise<T>;
}

async function send<T>(method: string, path: string, body?: object): Promise<T> {
  const headers = { "Content-Type": "application/json" };
  const init = body ? { method, headers, body: JSON.stringify(body) } : { method };
  return (await answerOf(path, init)).json() as Promise<T>;
}

const frameBase = (frame: number) => `/frames/${frame}`;

export const imageAddress = (frame: number, camera: string): string =>
  `${BASE}${frameBase(frame)}/images/${encodeURIComponent(camera)}`;

export const getSession = () => getJson<Session>("/session");

export const getEstimate = (frame: number, camera: string) =>
  getJson<Estimate>(`/estimate?frame=${frame}&camera=${encodeURIComponent(camera)}`);

export async function getCloud(frame: number): Promise<Float32Array> {
  return new Float32Array(await (await answerOf(`${frameBase(frame)}/cloud`)).arrayBuffer());
}

export async function getVisible(frame: number, camera: string, pose: Pose): Promise<Visible> {
  const path = `${frameBase(frame)}/visible/${encodeURIComponent(camera)}?pose=${pose}`;
  const data = await (await answerOf(path)).arrayBuffer();
  const count = new Uint32Array(data, 0, 1)[0] ?? 0;
  const at = (column: number) => 4 + 4 * count * column;
  return {
    rows: new Uint32Array(data, at(0), count),
    u: new Float32Array(data, at(1), count),
    v: new Float32Array(data, at(2), count),
    distance: new Float32Array(data, at(3), count),
  };
}

export async function getCorner(frame: number, camera: string, pixel: Pixel): Promise<Pixel | null> {
  const path = `${frameBase(frame)}/corner/${encodeURIComponent(camera)}?u=${pixel[0]}&v=${pixel[1]}`;
  return (await getJson<{ pixel_px: Pixel | null }>(path)).pixel_px;
}

export const addPair = (
  revision: number, frame: number, camera: string, pixel_px: Pixel, point_index: number,
) => send<Session>("POST", "/pairs", { revision, frame, camera, pixel_px, point_index });

export const changePair = (
  revision: number, place: number, change: { pixel_px?: Pixel; used?: boolean },
) => send<Session>("PATCH", `/pairs/${place}`, { revision, ...change });

export const removePair = (revision: number, place: number) =>
  send<Session>("POST", `/pairs/${place}/remove`, { revision });

export const undo = (revision: number) => send<Session>("POST", "/undo", { revision });
export const redo = (revision: number) => send<Session>("POST", "/redo", { revision });

export const writeReference = () =>
  send<{ files: string[]; cameras: string[] }>("POST", "/reference");
