// Keeps what the page shows behind the "#" of its address (data-address, which Python puts on the page), and tells Python
// of an address that it did not write itself: that of a link, of a bookmark or of a reload. What the server says before
// it has followed the newest link (data-followed) is older than that link.
(() => {
  const EVERY_MS = 250;
  let session = null, written = "", asked = 0, came = location.hash;
  const write = (hash) => history.replaceState(null, "", `${location.pathname}${location.search}${hash}`);

  // viser takes the page's address for that of its websocket, which may have no "#".
  if (came) write("");

  setInterval(() => {
    const said = document.querySelector("[data-address]");
    if (!said) return;
    const address = `#${said.dataset.address}`;
    if (came) {
      if (location.hash.length <= 1) write(came);  // else the page was sent elsewhere meanwhile
      came = "";
    }
    if (session !== said.dataset.session) {
      session = said.dataset.session;
      written = "";
      asked = 0;
    }
    if (location.hash.length > 1 && location.hash !== written) {
      written = location.hash;
      if (written === address) return;
      asked += 1;
      dispatchEvent(new CustomEvent("spherloc-touch", { detail: `link:${written.slice(1)}` }));
    } else if (Number(said.dataset.followed) >= asked && location.hash !== address && address.length > 1) {
      write(address);
      written = location.hash;
    }
  }, EVERY_MS);
})();
