// Sends the form with its progress shown; without this script the browser sends it as any other.
"use strict";
const form = document.getElementById("new"), bar = form.querySelector("progress"), button = form.querySelector("button");
const stop = (text) => {
  document.querySelector("[role=alert]").textContent = text;
  bar.hidden = true;
  button.disabled = false;
};
form.addEventListener("submit", (event) => {
  event.preventDefault();
  const request = new XMLHttpRequest();
  request.upload.onprogress = ({ loaded, total }) => { bar.max = total; bar.value = loaded; };
  request.onload = () => {
    if (request.status === 200) { location.assign(request.responseURL); return; }
    const page = new DOMParser().parseFromString(request.responseText, "text/html");
    stop(page.querySelector("[role=alert]")?.textContent || `refused (${request.status})`);
  };
  request.onerror = () => stop("The upload broke off. Is the server there, and the file not too large?");
  stop("");
  bar.hidden = false;
  button.disabled = true;
  request.open("POST", form.action);
  request.send(new FormData(form));
});
