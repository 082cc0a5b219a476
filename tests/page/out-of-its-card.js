// The cards that a text sticks out of.
() => [...document.querySelectorAll(".panel, .cause, .tile, .figures li")]
  .filter((card) => card.scrollWidth > card.clientWidth + 1).map((card) => card.textContent)
