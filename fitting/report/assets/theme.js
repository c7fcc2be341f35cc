// Light or dark: as the system says, until the button is pressed; paper is always light.

const element = (id) => document.getElementById(id);
const themeListeners = [];

// Calls this with each change, and at once.
function onTheme(changed) {
  themeListeners.push(changed);
  changed();
}

{
  const system = matchMedia("(prefers-color-scheme: dark)");
  let chosen = null;
  const show = (theme) => {
    document.documentElement.dataset.theme = theme;
    element("theme").setAttribute("aria-label", theme === "dark" ? "Switch to light" : "Switch to dark");
    for (const changed of themeListeners) changed();
  };
  const current = () => chosen ?? (system.matches ? "dark" : "light");
  system.addEventListener("change", () => show(current()));
  element("theme").addEventListener("click", () => {
    chosen = current() === "dark" ? "light" : "dark";
    show(chosen);
  });
  addEventListener("beforeprint", () => show("light"));
  addEventListener("afterprint", () => show(current()));
  show(current());
}
