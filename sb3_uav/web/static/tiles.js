// Map tiles of a server that the user has named, see https://wiki.openstreetmap.org/wiki/Slippy_map_tilenames.
const MOST_TILES = 256,
  TILE = 256;

export class Tiles {
  // A URL with {z}, {x}, {y}, and possibly {s}; what is called when a tile has come.
  constructor(url, onLoad) {
    this.url = url;
    this.onLoad = onLoad;
    this.images = new Map();
  }

  draw(pen, map) {
    const level = Math.max(0, Math.min(19, Math.round(Math.log2((map.scale * 360) / TILE)))),
      count = 2 ** level,
      size = 360 / count;
    const half = [map.width / 2 / map.scale, map.height / 2 / map.scale];
    for (
      let column = Math.floor((map.x - half[0] + 180) / size);
      column <= Math.floor((map.x + half[0] + 180) / size);
      column++
    ) {
      for (let row = Math.floor((map.y - half[1] + 180) / size); row <= Math.floor((map.y + half[1] + 180) / size); row++) {
        if (row < 0 || row >= count) continue;
        const image = this.image(level, ((column % count) + count) % count, row);
        if (!image.complete || !image.naturalWidth) continue;
        const [x, y] = map.screen([column * size - 180, row * size - 180]),
          width = size * map.scale;
        pen.drawImage(image, x, y, width + 0.5, width + 0.5);
      }
    }
  }

  image(level, column, row) {
    const values = { z: level, x: column, y: row, s: "abc"[(column + row) % 3] };
    const url = this.url.replace(/\{([zxys])\}/g, (_, name) => values[name]);
    let image = this.images.get(url);
    if (!image) {
      image = new Image();
      image.onload = () => this.onLoad();
      image.src = url;
      if (this.images.size >= MOST_TILES) this.images.delete(this.images.keys().next().value);
      this.images.set(url, image);
    }
    return image;
  }
}
