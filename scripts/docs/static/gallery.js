// Buttons of the gallery: a card is shown when it has the chosen class of every row.
document.addEventListener("DOMContentLoaded", () => {
  const rows = [...document.querySelectorAll(".filter p")];
  const cards = [...document.querySelectorAll(".systems .sd-col")];
  for (const button of document.querySelectorAll(".filter button")) {
    button.addEventListener("click", () => {
      button.parentElement.querySelectorAll("button").forEach((b) => b.classList.toggle("on", b === button));
      const wanted = rows.map((row) => row.querySelector("button.on").dataset.only).filter(Boolean);
      cards.forEach((card) => card.classList.toggle("hidden", !wanted.every((w) => card.classList.contains(w))));
    });
  }
});
