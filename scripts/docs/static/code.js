// A button on every block of code that puts it on the clipboard; a click on a picture shows it by itself.
document.addEventListener("DOMContentLoaded", () => {
  for (const picture of document.querySelectorAll("article img:not(a *, .sd-card *, [src^='data:'])")) {
    const link = document.createElement("a");
    link.href = picture.src;
    picture.replaceWith(link);
    link.append(picture);
  }
  for (const block of document.querySelectorAll("article div.highlight")) {
    const code = block.querySelector("pre");
    if (!code || !navigator.clipboard) continue; // a page from the disk may have none
    const text = code.textContent;
    const button = document.createElement("button");
    button.type = "button";
    button.className = "copy";
    button.textContent = "Copy";
    button.addEventListener("click", async () => {
      await navigator.clipboard.writeText(text);
      button.textContent = "Copied";
      setTimeout(() => (button.textContent = "Copy"), 1500);
    });
    block.append(button);
  }
});
