// The page as a whole: its parts, downloads and keys.
PARTS.warnings = (data, arrays) => {
  for (const link of document.querySelectorAll(".download")) {
    link.addEventListener("click", (event) => {
      event.preventDefault();
      save(link.dataset.file, new Blob([arrays.warnings[link.dataset.file]], { type: "text/plain" }));
    });
  }
};

function listenToKeys(clock) {
  document.addEventListener("keydown", (event) => {
    const name = event.target.tagName, isField = name === "INPUT" || name === "SELECT";
    if (event.ctrlKey || event.metaKey || event.altKey || event.shiftKey) return;
    const steps = { ArrowLeft: -1, ArrowRight: 1, Home: -clock.times.length, End: clock.times.length };
    if (event.key in steps && !isField) {
      clock.show(clock.index + steps[event.key]);
      event.preventDefault();
    } else if (event.key === " " && !isField && !["BUTTON", "SUMMARY", "A"].includes(name)) {
      document.getElementById("play")?.click();
      event.preventDefault();
    }
  });
}

// What is drawn has its place and its words; what this run has not goes.
function showParts() {
  for (const card of document.querySelectorAll("[data-part]")) {
    const data = PAGE.parts[card.dataset.part];
    card.hidden = false;
    if (!data) card.remove();
    else for (const place of card.querySelectorAll("[data-text]")) place.textContent = data[place.dataset.text];
  }
}

async function start() {
  showParts();
  const arrays = await unpacked();
  const times = PAGE.parts.view?.times ?? PAGE.parts.curves?.times ?? [0];
  const clock = new Clock(times);
  for (const [name, data] of Object.entries(PAGE.parts)) PARTS[name]?.(data, arrays, clock);
  listenToKeys(clock);
  clock.show(times.length - 1);
  globalThis.REPORT = { clock, arrays, page: PAGE };  // for tests, and for whoever looks from the console
  document.documentElement.dataset.ready = "yes";
}
start();
