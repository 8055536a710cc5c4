// The clock of the replay: time, speed, play, pause, loop.

function createPlayer(recording, changed) {
  const player = { time: 0, speed: 1, playing: false, looping: true };
  const { duration, data } = recording;

  function seek(time) {
    player.time = Math.min(Math.max(time, 0), duration);
    changed();
  }

  function play(on) {
    player.playing = on && duration > 0;
    if (player.playing && player.time >= duration) player.time = 0;
    changed();
  }

  /** To a neighbouring recorded frame, paused. */
  function stepFrames(count) {
    play(false);
    seek((recording.frameAt(player.time) + count) * data.dt);
  }

  function advance(seconds) {
    if (!player.playing) return;
    const time = player.time + seconds * player.speed;
    if (time >= duration && !player.looping) play(false);
    seek(time >= duration && player.looping ? 0 : time);
  }

  return Object.assign(player, { seek, play, stepFrames, advance });
}
