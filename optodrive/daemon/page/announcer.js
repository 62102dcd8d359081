// What a screen reader says by itself: each text is an element of its own, so that two in a row are both said.

const KEPT = 5; // the newest ones; a reader that has not said an older one by then would be late

export class Announcer {
  // region: a live region, whose additions screen readers say
  constructor(region) {
    this.region = region;
  }

  say(text) {
    if (text) {
      this.region.append(Object.assign(document.createElement("p"), { textContent: text }));
      while (this.region.childElementCount > KEPT) {
        this.region.firstElementChild.remove();
      }
    }
  }
}
