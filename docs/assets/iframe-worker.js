// Browsers refuse workers to pages that are opened from a folder. There, the search runs in a hidden frame instead.
(() => {
  if (location.protocol !== "file:") return;
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.append(this.frame);
      const end = "</" + "script>";
      const prelude = `
        window.postMessage = data => parent.dispatchEvent(new MessageEvent("worker-said", { data, source: window }));
        window.importScripts = (...urls) => urls.reduce((before, url) => before.then(() => new Promise(done => {
          const script = document.createElement("script");
          script.src = url;
          script.onload = done;
          document.body.append(script);
        })), Promise.resolve());`;
      const page = this.frame.contentDocument;
      page.open();
      page.write(`<body><script>${prelude}${end}<script src="${url}">${end}</body>`);
      page.close();
      addEventListener("worker-said", event => {
        if (event.source !== this.frame.contentWindow) return;
        const message = new MessageEvent("message", { data: event.data });
        this.onmessage?.(message);
        this.dispatchEvent(message);
      });
      this.ready = new Promise(done => { this.frame.onload = done; });
    }
    postMessage(data) {
      this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })));
    }
    terminate() {
      this.frame.remove();
    }
  };
})();
