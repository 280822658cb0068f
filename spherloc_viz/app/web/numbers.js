// The number box of a slider: Enter takes what was typed, within the slider's ends, and a box that is left without a
// number has that of its slider again.
(() => {
  const write = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
  const isNumber = (one) => one instanceof HTMLInputElement && one.inputMode !== "" && row(one) !== null;
  const row = (one) => one.closest("[class*=Flex-root]:has([role=slider])");

  addEventListener("keydown", (event) => {
    if (event.key === "Enter" && isNumber(event.target)) event.target.blur();
  });
  addEventListener("focusout", (event) => {
    const box = event.target;
    if (!isNumber(box) || box.value !== "") return;
    write.call(box, row(box).querySelector("[role=slider]").getAttribute("aria-valuenow"));
    box.dispatchEvent(new Event("input", { bubbles: true }));
  });
})();
