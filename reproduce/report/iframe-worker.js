// The search wants a worker, which browsers refuse to a page that was opened from a file: there, a hidden frame serves.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.waiting = [] // messages that come before the frame has its script
      const frame = document.createElement("iframe")
      frame.hidden = true
      frame.addEventListener("load", () => {
        const scope = frame.contentWindow
        // what a worker posts goes to its page; a window would post to itself
        scope.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }))
        const script = scope.document.createElement("script")
        script.src = url
        script.onload = () => {
          this.receive = data => scope.dispatchEvent(new scope.MessageEvent("message", { data }))
          this.waiting.forEach(this.receive)
        }
        scope.document.head.appendChild(script)
      })
      document.head.appendChild(frame)
    }
    postMessage(data) {
      this.receive ? this.receive(data) : this.waiting.push(data)
    }
  }
}
