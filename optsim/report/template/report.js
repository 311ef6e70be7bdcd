const root = document.documentElement;
document.getElementById("theme").addEventListener("click", () => {
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
});
for (const box of document.querySelectorAll("[data-reveal]")) {
  const picture = box.querySelector(".reveal");
  const show = (select, image) => {
    const chosen = select.selectedOptions[0];
    image.src = chosen.value;
    image.alt = chosen.textContent;
  };
  box.querySelector("input").addEventListener("input", (e) => picture.style.setProperty("--cut", e.target.value + "%"));
  box.querySelectorAll("select").forEach((select, i) => {
    select.addEventListener("change", () => show(select, picture.querySelectorAll("img")[1 - i]));
  });
}
for (const button of document.querySelectorAll("[data-play]")) {
  const image = document.getElementById(button.dataset.play);
  const set = (playing) => {
    image.src = playing ? image.dataset.film : image.dataset.still;
    button.textContent = playing ? "Pause" : "Play";
  };
  set(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  button.addEventListener("click", () => set(button.textContent === "Play"));
}
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((d) => (d.open = true)));
