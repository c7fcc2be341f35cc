// The program that serves the page, which has its clips, solves them and saves what was changed.

async function post(path, content) {
  const response = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(content) });
  if (!response.ok) throw new Error(await response.text());
  return response;
}

const base64Of = (array) => btoa(Array.from(new Uint8Array(array.buffer), (byte) => String.fromCharCode(byte)).join(""));

// Solves a clip, with the face of a worker.
class RemoteSolver {
  constructor(clip) {
    this.clip = clip;
  }

  async postMessage({ parameters, layers }) {
    try {
      const response = await post("solve", { clip: this.clip, values: base64Of(parameters), layers });
      this.onmessage({ data: this.read(await response.arrayBuffer()) });
    } catch (error) {
      this.onerror({ message: error.message });
    }
  }

  // The length of a JSON text, the text, and after it the arrays that it lists, one after another.
  read(buffer) {
    const length = new Uint32Array(buffer, 0, 1)[0];
    const { arrays, ...solution } = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const kinds = { f4: Float32Array, i2: Int16Array, u1: Uint8Array };
    let offset = 4 + length;
    for (const [name, kind, count] of arrays) {
      const size = count * kinds[kind].BYTES_PER_ELEMENT;
      solution[name] = new kinds[kind](buffer.slice(offset, offset + size));
      offset += size;
    }
    return solution;
  }

  terminate() {}
}

class Program {
  solver(clip) {
    return new RemoteSolver(clip);
  }

  async clip(index) {
    return (await fetch(`clip/${index}`)).json();
  }

  // Writes the values of all sliders; what was written, in sentences.
  async save(values, drop) {
    return (await post("save", { values: base64Of(values), drop })).json();
  }

  // Writes the stances of a clip; the clip as it is read with them, and a message.
  async saveContacts(clip, legs) {
    return (await post("contacts", { clip, legs })).json();
  }

  // Passes on better points while a fit goes on, until the program ends.
  async follow(receive) {
    for (let number = 0; ; ) {
      const news = await (await fetch(`news/${number}`)).json();
      if (news.number > number) await receive(news);
      number = news.number;
    }
  }
}
