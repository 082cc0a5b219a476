// The texts that are wider than their cells, and the words that stand in two lines, without those
// with a hyphen or slash, where lines may end, and without long ones: the ids of releases.
() => {
  const broken = [];
  for (const cell of document.querySelectorAll("td, th, h1, h2, h3, dd, .badge, .figures li")) {
    if (cell.clientWidth && cell.scrollWidth > cell.clientWidth + 1) broken.push(cell.textContent);
    const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
    for (let text = walker.nextNode(); text; text = walker.nextNode()) {
      for (const word of text.data.matchAll(/[\p{L}\p{N}_.]+/gu)) {
        if (word[0].length > 24) continue;
        const range = document.createRange();
        range.setStart(text, word.index);
        range.setEnd(text, word.index + word[0].length);
        const lines = new Set([...range.getClientRects()].map((box) => box.top));
        if (lines.size > 1) broken.push(word[0]);
      }
    }
  }
  return broken;
}
