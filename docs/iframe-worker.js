// Search in pages that were opened from the disk: browsers start no worker there, so its script runs in a hidden frame.
if (location.protocol === "file:") {
  window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super();
      this.waiting = [];
      const frame = this.frame = document.createElement("iframe");
      frame.hidden = true;
      frame.srcdoc = "<body><script>" +
        "self.postMessage = data => parent.postMessage({worker: true, data}, '*');" +
        "self.importScripts = (...urls) => urls.reduce((before, url) => before.then(() => new Promise(done => {" +
        "const s = document.createElement('script'); s.src = url; s.onload = done; document.body.append(s); })), " +
        "Promise.resolve());</scr" + "ipt><script src=\"" + new URL(url, document.baseURI) + "\"></scr" + "ipt>";
      document.body.append(frame);
      frame.onload = () => {
        this.loaded = true;
        this.waiting.splice(0).forEach(data => this.postMessage(data));
      };
      addEventListener("message", event => {
        if (event.source !== frame.contentWindow || !event.data.worker) return;
        const told = new MessageEvent("message", {data: event.data.data});
        this.dispatchEvent(told);
        if (this.onmessage) this.onmessage(told);
      });
    }
    postMessage(data) {
      if (!this.loaded) return this.waiting.push(data);
      this.frame.contentWindow.dispatchEvent(new MessageEvent("message", {data}));
    }
    terminate() { this.frame.remove(); }
  };
  window.Worker = window.IFrameWorker;
}
