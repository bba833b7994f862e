// The websocket to the bridge: it comes back by itself when it is lost.

const RETRY_MS = [250, 500, 1000, 2000];

/** The token of the address, kept for this tab and taken out of the address bar. */
function token() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("token", given);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem("token") || "";
}

/** Calls `take(record)` for every record and `state("open" | "lost" | "refused")`; returns {send}. */
export function connect(take, state) {
  const url = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`;
  const secret = token();
  let socket = null;
  let failures = 0;

  function open() {
    socket = new WebSocket(url);
    socket.onopen = () => socket.send(JSON.stringify({ token: secret }));
    socket.onmessage = (message) => {
      if (failures >= 0) state("open");
      failures = -1;
      for (const record of JSON.parse(message.data)) take(record);
    };
    socket.onclose = (event) => {
      const refused = event.code === 1008;
      state(refused ? "refused" : "lost");
      failures = Math.max(0, failures);
      setTimeout(open, refused ? 5000 : RETRY_MS[Math.min(failures++, RETRY_MS.length - 1)]);
    };
  }

  open();
  return {
    send(order) {
      if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(order));
    },
  };
}
