"use strict";
// What is stored by the server: labels and notes, with undo, and the requests for it.

const AT_ONCE = 200; // runs that one request labels

async function asked(address) {
  const answer = await fetch(address);
  if (answer.status === 204) return null;
  const told = await answer.json();
  if (!answer.ok) throw new Error(told.error || answer.statusText);
  return told;
}

async function done(what) {
  const answer = await fetch("/desk/do", {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(what),
  });
  let told = {};
  try { told = await answer.json(); } catch { /* an answer of the door is one sentence */ }
  if (!answer.ok) throw new Error(told.error || `${answer.status} ${answer.statusText}`);
  return told;
}

// Labels and notes are sent one request after another; each step can be undone.
class Reviews {
  constructor(runs, changed, say) {
    this.runs = runs; this.changed = changed; this.say = say;
    this.steps = []; // of undo: changes that take a step back
    this.queue = Promise.resolve();
  }

  // make() gives {changes: [{file, add, remove, note}], words} when all that was asked before is done: a label that is
  // pressed twice is given and taken away, however quickly.
  change(make) {
    this.queue = this.queue.then(() => {
      const { changes, words } = make();
      return changes.length ? this.send(changes, words, true) : undefined;
    }).catch((error) => this.say(error.message, true));
    return this.queue;
  }

  // Runs work() when what was asked before is done: a list that is read between two requests lacks the labels of one.
  between(work) {
    this.queue = this.queue.then(work).catch(() => { /* the server is away; the next time tells */ });
    return this.queue;
  }

  // What was asked before is done first, so that a quick key takes back the change that is still on its way.
  undo() {
    this.queue = this.queue.then(() => {
      const step = this.steps.pop();
      return step && this.send(step.back, `Undone: ${step.words}`, false);
    }).catch((error) => this.say(error.message, true));
    return this.queue;
  }

  async send(changes, words, undoable) {
    const back = [], failed = [];
    for (let at = 0; at < changes.length; at += AT_ONCE) {
      if (changes.length > AT_ONCE) this.say(`${words} … ${at.toLocaleString("en")} of ${changes.length.toLocaleString("en")}`);
      const told = await done({ do: "review", changes: changes.slice(at, at + AT_ONCE) });
      for (const run of told.done) {
        const removed = run.before.filter((label) => !run.labels.includes(label));
        const added = run.labels.filter((label) => !run.before.includes(label));
        const note = run.note === run.noteBefore ? null : run.noteBefore;
        if (removed.length || added.length || note !== null) back.push({ file: run.file, add: removed, remove: added, note });
        this.runs.reviewed(run.file, run.labels, run.note);
      }
      failed.push(...told.failed);
      this.runs.version = told.version;
    }
    this.runs.findPageRuns();
    if (undoable && back.length) this.steps.push({ back, words });
    this.changed();
    if (failed.length) this.say(`${failed.length} could not be labelled: ${failed[0].error}`, true);
    else this.say(words);
  }
}
