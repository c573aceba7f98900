// The search wants a worker, which browsers refuse to a page that was opened from a file: there, a hidden frame serves.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      this.waiting = [] // messages that come before the frame has its script
      frame.addEventListener("load", () => {
        const scope = frame.contentWindow
        // what a worker posts goes to its page; a window would post to itself
        scope.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }))
        scope.importScripts = (...files) => files.reduce((done, file) => done.then(() => run(scope, file)), Promise.resolve())
        run(scope, url).then(() => {
          this.receive = data => scope.dispatchEvent(new scope.MessageEvent("message", { data }))
          this.waiting.forEach(this.receive)
        })
      })
      document.head.appendChild(frame)
    }
    postMessage(data) {
      this.receive ? this.receive(data) : this.waiting.push(data)
    }
  }
  const run = (scope, file) => new Promise((resolve, reject) => {
    const script = scope.document.createElement("script")
    Object.assign(script, { src: file, onload: resolve, onerror: reject })
    scope.document.head.appendChild(script)
  })
}
