// Tabs, theme, and what the page's data say is to be drawn.

const DATA = JSON.parse(document.getElementById("data").textContent);

function selectTab(tabs, tab) {
  for (const one of tabs) {
    const chosen = one === tab;
    one.setAttribute("aria-selected", String(chosen));
    one.tabIndex = chosen ? 0 : -1;
    document.getElementById(one.getAttribute("aria-controls")).hidden = !chosen;
  }
  for (const draw of redraws) draw();
}

function setUpTabs() {
  const tabs = [...document.querySelectorAll('[role="tab"]')];
  tabs.forEach((tab, i) => {
    tab.addEventListener("click", () => selectTab(tabs, tab));
    tab.addEventListener("keydown", (event) => {
      const steps = { ArrowRight: i + 1, ArrowLeft: i - 1, Home: 0, End: tabs.length - 1 };
      if (!(event.key in steps)) return;
      event.preventDefault();
      const next = tabs[(steps[event.key] + tabs.length) % tabs.length];
      selectTab(tabs, next);
      next.focus();
    });
  });
  // An address may end with the name of a section, which is no id: nothing scrolls or is focused.
  const go = () => {
    const named = tabs.find((tab) => tab.id === `tab-${location.hash.slice(1)}`);
    if (tabs.length) selectTab(tabs, named ?? tabs[0]);
  };
  window.addEventListener("hashchange", go);
  go();
}

function setUpTheme() {
  const button = document.getElementById("theme");
  const wish = window.matchMedia("(prefers-color-scheme: dark)");
  const use = (dark) => {
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    button.textContent = dark ? "Light" : "Dark";
    button.setAttribute("aria-label", `Use ${dark ? "light" : "dark"} colors`);
  };
  button.addEventListener("click", () => use(document.documentElement.dataset.theme !== "dark"));
  wish.addEventListener("change", () => use(wish.matches));
  use(wish.matches);
}

document.body.classList.remove("plain");
setUpTheme();
for (const place of document.querySelectorAll(".chart")) chart(place, DATA.charts[Number(place.dataset.number)]);
const browserPlace = document.getElementById("browser");
if (browserPlace) browser(browserPlace, DATA.episodes);
setUpTabs();
let width = window.innerWidth;
window.addEventListener("resize", () => {
  if (window.innerWidth === width) return; // a phone's bars that come and go
  width = window.innerWidth;
  for (const draw of redraws) draw();
});
