// Begins once everything else is there.

const program = typeof Program === "undefined" ? null : new Program();
const player = new Player(JSON.parse(element("data").textContent).clips, program);
onTheme(() => {
  if (!player.palette) return;
  player.readPalette();
  player.frame(performance.now());
  player.drawStill();
});
if (element("live") && player.stage) player.live = new LivePanel(player);

if (program && player.stage) {
  element("live").open = true;
  const end = () => player.live.say("The program that served this page has ended.");
  program.follow(({ name, values, note }) => player.live.replace(name, values, note)).catch(end);
}
