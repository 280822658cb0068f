// Keeps what a person typed or dragged. Every change of a widget gets a number and is sent to the server with it; a value
// from the server carries the number of the newest change that it answers. A value that answers none so new as the
// widget's own is dropped, also while it waits to be shown; while something is typed that the server has not been told
// yet, values for its field wait. It stands between viser's page and the worker that holds viser's websocket; all that
// leans on viser's client is in here. Goes before viser's own script.
(() => {
  const EVERY_MS = 50, VISERS_THROTTLE_MS = 50, FAR = 8, later = window.setTimeout.bind(window), Plain = window.Worker;
  const POSES = ["SetPositionMessage", "SetOrientationMessage"], BUTTONS = ["GuiButtonMessage", "GuiButtonGroupMessage"];
  // A page that was opened by a link (link.js) says so when it connects: the server solves nothing before it has the link.
  const MAX_LETTERS = 15000, LINKED = location.hash.length > 1 && location.hash.length <= MAX_LETTERS ? "?linked" : "";
  let number = 0, gesture = 0, throttled = false, edited = null, line = null;

  // viser's page sends the changes of all widgets through one throttle that keeps only the last of those within 50 ms.
  // It begins to wait right after it has sent one: that wait is none here, and changes are gathered below by widget.
  window.setTimeout = (task, delay, ...words) => {
    if (!throttled || delay !== VISERS_THROTTLE_MS) return later(task, delay, ...words);
    throttled = false;
    task(...words);
    return 0;
  };

  class Line extends Plain {
    #changed = new Map();   // number of the newest change, by widget or node
    #buttons = new Set();
    #widgets = new Set();
    #waiting = [];          // changes that are not sent yet, one for each widget since the last press of a button
    #sent = -Infinity;
    #timer = null;
    #posed = new Map();     // what the poses that come next for a node answer
    #withheld = new Map();  // values for what is being typed into

    constructor(...words) {
      super(...words);
      this.addEventListener("message", ({ data }) => {
        if (data?.type === "connected") this.#begin();
        if (data?.type !== "message_batch") return;
        data.messages = data.messages.filter((message) => this.#keep(message));
        this.release();
      });
      // Only then has viser's page set its own handler, after which this one is called.
      queueMicrotask(() => this.addEventListener("message", ({ data }) => showTogether(data)));
    }

    postMessage(data, ...words) {
      if (data?.type === "set_server") super.postMessage({ ...data, server: data.server + LINKED }, ...words);
      else if (data?.type !== "send") super.postMessage(data, ...words);
      else if (data.message.type === "GuiUpdateMessage") this.#change(data.message);
      else {
        // All but the place of the viewer, which is told many times a second, has a number too.
        const { type, name } = data.message, isView = type === "ViewerCameraMessage";
        if (type === "TransformControlsUpdateMessage") this.report(name, {});
        else if (!isView) this.report("", {});
        super.postMessage(isView ? { ...data, message: inPagePixels(data.message) } : data, ...words);
      }
    }

    // Sends a message that goes by no widget, after all changes before it.
    report(name, updates) {
      this.#note(name);
      this.#waiting.push(this.#numbered({ type: "GuiUpdateMessage", uuid: name, updates }));
      this.flush();
    }

    // Sends what is not sent yet.
    flush() {
      clearTimeout(this.#timer);
      this.#timer = null;
      if (this.#waiting.length === 0) return;
      this.#sent = performance.now();
      for (const message of this.#waiting.splice(0)) super.postMessage({ type: "send", message });
    }

    // The widget that a field belongs to: the field itself, or what stands near it, has its name.
    widgetOf(field) {
      for (let part = field, far = 0; part && far < FAR; part = part.parentElement, far += 1) {
        const names = [part, ...part.querySelectorAll("[id],label")].map((one) => one.id || one.htmlFor);
        const found = names.find((name) => this.#widgets.has(name));
        if (found) return found;
      }
      return null;
    }

    // Shows the values that waited for an end of typing.
    release() {
      for (const [uuid, message] of [...this.#withheld]) {
        if (this.#isEdited(uuid)) continue;
        this.#withheld.delete(uuid);
        this.dispatchEvent(new MessageEvent("message", { data: { type: "message_batch", messages: [message] } }));
      }
    }

    #begin() {
      line = this;
      for (const all of [this.#changed, this.#buttons, this.#widgets, this.#posed, this.#withheld]) all.clear();
      this.#waiting.length = 0;
    }

    #isEdited(uuid) {
      return edited?.uuid === uuid && edited.field === document.activeElement;
    }

    #numbered(message) {
      return { ...message, updates: { ...message.updates, change: number, gesture } };
    }

    #note(name) {
      this.#changed.set(name, ++number);
      if (edited?.uuid === name) edited = null;
      const queue = window.__viserMutable?.messageQueue ?? [];
      for (let k = queue.length - 1; k >= 0; k--) if (nameOfValue(queue[k]) === name) queue.splice(k, 1);
    }

    #change(message) {
      throttled = true;
      queueMicrotask(() => { throttled = false; });
      const uuid = message.uuid, isButton = this.#buttons.has(uuid);
      this.#note(uuid);
      const place = isButton ? -1 : this.#waiting.findIndex((one) => one.uuid === uuid);
      if (place >= 0) this.#waiting.splice(place, 1);
      this.#waiting.push(this.#numbered(message));
      const wait = this.#sent + EVERY_MS - performance.now();
      if (isButton || wait <= 0) this.flush();
      else this.#timer ??= later(() => this.flush(), wait);
    }

    // Whether viser's page is to see a message.
    #keep(message) {
      const { type, uuid, updates } = message;
      if (type.startsWith("Gui") && message.props) {
        this.#widgets.add(uuid);
        if (BUTTONS.includes(type)) this.#buttons.add(uuid);
      }
      if (type === "GuiUpdateMessage" && "answers" in updates && !("value" in updates)) {
        this.#posed.set(uuid, updates.answers);
        return false;
      }
      const name = nameOfValue(message);
      if (name === null) return true;
      const answers = POSES.includes(type) ? this.#posed.get(name) : updates.answers;
      if (answers !== undefined && answers < (this.#changed.get(name) ?? 0)) return false;
      if (this.#isEdited(name)) {
        this.#withheld.set(name, message);
        return false;
      }
      if (updates) message.updates = Object.fromEntries(Object.entries(updates).filter(([key]) => key !== "answers"));
      return true;
    }
  }

  // viser tells the canvas' size in pixels of the screen, of which a sharp one has several for one of the page's, and a
  // slow page draws fewer. Panels and words are measured in the page's.
  function inPagePixels(message) {
    const { clientWidth: width, clientHeight: height } = window.__viserMutable?.canvas ?? {};
    return width && height ? { ...message, image_width: width, image_height: height } : message;
  }

  // viser's page takes messages in its next frame, which moves the viewer at once and still has the objects of before:
  // React changes them after it. Messages that move the viewer are taken now, so that one frame shows all.
  function showTogether({ type, messages }) {
    if (type !== "message_batch" || !messages.some((message) => message.type.startsWith("SetCamera"))) return;
    window.__viserMutable?.drainMessageQueue?.();
  }

  // What a message gives a value or a pose to; null if it gives none.
  function nameOfValue({ type, uuid, name, updates }) {
    if (POSES.includes(type)) return name;
    return type === "GuiUpdateMessage" && "value" in updates ? uuid : null;
  }

  window.Worker = Line;
  // What is pressed goes the same way, so that nothing overtakes it.
  window.spherlocReport = (touch) => line?.report("", { touch });

  // Before viser's page hears of it: if it tells the server of it, that ends the state of not being told.
  addEventListener("input", ({ target: field }) => {
    const isTyped = field instanceof Element && field.matches("textarea,input:not([type=checkbox]):not([type=radio])");
    const uuid = isTyped && line ? line.widgetOf(field) : null;
    edited = uuid === null ? null : { uuid, field };
  }, true);
  addEventListener("focusout", () => later(() => line?.release(), 0), true);
  for (const kind of ["pointerdown", "keydown"])
    addEventListener(kind, (event) => { if (!event.repeat) gesture += 1; }, true);
})();
