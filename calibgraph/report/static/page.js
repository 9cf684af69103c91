"use strict";
document.documentElement.classList.add("js");
for (const box of document.querySelectorAll(".overlays"))
  box.querySelector("input").addEventListener("input", (event) => box.style.setProperty("--cut", event.target.value));
for (const button of document.querySelectorAll(".copyable button"))
  button.addEventListener("click", async () => {
    const text = button.nextElementSibling;
    try {
      await navigator.clipboard.writeText(text.textContent);
    } catch { // no clipboard in this page, as in a sandbox
      getSelection().selectAllChildren(text);
      document.execCommand("copy");
    }
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy"; }, 2000);
  });
// Open all folded parts for printing, and fold them again afterwards.
let unfolded = [];
addEventListener("beforeprint", () => { unfolded = [...document.querySelectorAll("details:not([open])")]; for (const part of unfolded) part.open = true; });
addEventListener("afterprint", () => { for (const part of unfolded) part.open = false; });
