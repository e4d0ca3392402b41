// Puts the page together once its numbers are unpacked.
const CHARTS = { lines: Chart, joint: JointChart, ground: GroundChart };

function themes() {
  const root = document.documentElement, button = document.getElementById("theme");
  const set = (theme) => {
    root.dataset.theme = theme;
    if (button) button.textContent = theme === "dark" ? "light" : "dark";
    document.dispatchEvent(new Event("themechange"));
  };
  button?.addEventListener("click", () => set(root.dataset.theme === "dark" ? "light" : "dark"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", (e) => set(e.matches ? "dark" : "light"));
  set(root.dataset.theme);
}

function copies() {
  for (const button of document.querySelectorAll("button[data-copy]")) {
    button.addEventListener("click", async () => {
      const text = document.getElementById(button.dataset.copy).textContent;
      try {
        await navigator.clipboard.writeText(text);
        button.textContent = "copied";
      } catch {
        getSelection().selectAllChildren(document.getElementById(button.dataset.copy));
        button.textContent = "selected";
      }
      setTimeout(() => (button.textContent = "copy"), 1500);
    });
  }
}

async function main() {
  themes();
  copies();
  const note = (text) => document.getElementById("trouble").append(make("p", { class: "note" }, text));
  if (typeof DecompressionStream === "undefined") {
    note("This browser is too old for the plots and the animation: it needs DecompressionStream (2023).");
    return;
  }
  const { header, arrays } = await unpack(document.getElementById("numbers").textContent);
  const stage = document.getElementById("animation");
  const clock = stage && header.tracks ? new Player(stage, header, arrays) : null;
  const places = document.getElementById("charts");
  for (const spec of header.charts ?? []) places.append(new CHARTS[spec.kind](spec, arrays, clock).root);
  document.documentElement.dataset.ready = "";
  window.page = { header, arrays, clock };
}

main().catch((error) => {
  document.getElementById("trouble").append(make("p", { class: "note" }, `This page is damaged: ${error.message}`));
  throw error;
});
