// Shows how far a job is, and the page of its result when it is finished.
"use strict";
const stage = document.getElementById("stage");
const source = new EventSource(stage.dataset.events);
const show = (event) => {
  const job = JSON.parse(event.data);
  if (["succeeded", "failed", "cancelled"].includes(job.state)) {
    source.close();
    location.reload();
    return;
  }
  const steps = job.progress;
  stage.textContent = steps ? `${steps.stage} ${steps.done} of ${steps.total}` : job.state;
};
for (const state of ["queued", "running", "succeeded", "failed", "cancelled"]) {
  source.addEventListener(state, show);
}
