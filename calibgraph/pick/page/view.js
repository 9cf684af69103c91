// A canvas that zooms and pans over content of a stated size, with a cross.

const CLICK = 4; // pixels that a click may move

export class View {
  // draw(context, view) draws the content; pick(x, y) is called with a place of it.
  constructor(canvas, { draw, pick }) {
    this.canvas = canvas;
    this.draw = draw;
    this.pick = pick;
    this.size = [1, 1];
    this.scale = 1; // pixels of the screen for a unit of content
    this.origin = [0, 0]; // the content in the upper left corner
    this.cross = null; // of the screen
    this.pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("pointerleave", () => this.put(null));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 400), this.at(event));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.fit(true)).observe(canvas);
  }

  // Content of another size, shown whole; null keeps the place that is shown.
  show(size, middle = null, scale = null) {
    this.size = size;
    this.home = [middle, scale];
    this.fit();
  }

  fit(keep = false) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = devicePixelRatio || 1;
    this.canvas.width = Math.max(1, width * ratio);
    this.canvas.height = Math.max(1, height * ratio);
    this.ratio = ratio;
    if (!keep || !this.home) {
      const [middle, scale] = this.home ?? [null, null];
      this.scale = scale ?? Math.min(width / this.size[0], height / this.size[1]);
      const [x, y] = middle ?? [this.size[0] / 2, this.size[1] / 2];
      this.origin = [x - width / this.scale / 2, y - height / this.scale / 2];
    }
    this.redraw();
  }

  toScreen(x, y) {
    return [(x - this.origin[0]) * this.scale, (y - this.origin[1]) * this.scale];
  }

  toContent([x, y]) {
    return [x / this.scale + this.origin[0], y / this.scale + this.origin[1]];
  }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  zoom(factor, about) {
    const [x, y] = this.toContent(about);
    this.scale = Math.min(80, Math.max(0.02, this.scale * factor));
    this.origin = [x - about[0] / this.scale, y - about[1] / this.scale];
    this.redraw();
  }

  put(cross) {
    this.cross = cross;
    this.redraw();
  }

  press(event) {
    this.canvas.focus();
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, this.at(event));
    this.moved = this.pointers.size > 1 ? Infinity : 0;
  }

  move(event) {
    const place = this.at(event);
    const before = this.pointers.get(event.pointerId);
    if (before) {
      const step = [place[0] - before[0], place[1] - before[1]];
      this.moved += Math.hypot(...step);
      const others = [...this.pointers].filter(([id]) => id !== event.pointerId);
      if (others.length) {
        const fixed = others[0][1];
        const distance = (p) => Math.hypot(p[0] - fixed[0], p[1] - fixed[1]) || 1;
        this.zoom(distance(place) / distance(before), fixed);
      } else if (this.moved > CLICK) {
        this.origin = [this.origin[0] - step[0] / this.scale, this.origin[1] - step[1] / this.scale];
      }
      this.pointers.set(event.pointerId, place);
    }
    this.put(place);
  }

  release(event) {
    this.pointers.delete(event.pointerId);
    if (this.moved <= CLICK) this.pick(...this.toContent(this.at(event)));
  }

  key(event) {
    const middle = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
    const place = this.cross ?? middle;
    const step = event.shiftKey ? 20 : 1;
    const steps = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (steps[event.key]) this.put([place[0] + steps[event.key][0], place[1] + steps[event.key][1]]);
    else if (event.key === "Enter") this.pick(...this.toContent(place));
    else if (event.key === "+" || event.key === "=") this.zoom(1.5, place);
    else if (event.key === "-") this.zoom(1 / 1.5, place);
    else if (event.key === "0") this.fit();
    else return;
    event.preventDefault();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = 0;
      const context = this.canvas.getContext("2d");
      context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
      context.clearRect(0, 0, this.canvas.clientWidth, this.canvas.clientHeight);
      this.draw(context, this);
      if (this.cross) this.drawCross(context);
    });
  }

  drawCross(context) {
    const [x, y] = this.cross;
    context.strokeStyle = "#fff";
    line(context, [x - 12, y], [x + 12, y]);
    line(context, [x, y - 12], [x, y + 12]);
  }

  // The part of the content that is visible: left, top, right, bottom.
  visible() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const [left, top] = this.origin;
    return [left, top, left + width / this.scale, top + height / this.scale];
  }
}

export function line(context, from, to) {
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
}

// A numbered ring about a place.
export function mark(context, [x, y], text, colour) {
  context.lineWidth = 2;
  context.strokeStyle = colour;
  context.beginPath();
  context.arc(x, y, 6, 0, 2 * Math.PI);
  context.stroke();
  context.font = "bold 13px system-ui, sans-serif";
  context.lineWidth = 3;
  context.strokeStyle = "#000";
  context.strokeText(text, x + 8, y - 6);
  context.fillStyle = colour;
  context.fillText(text, x + 8, y - 6);
  context.lineWidth = 1;
}
