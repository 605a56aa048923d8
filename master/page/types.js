/**
 * Shapes of what modules pass to each other. Comments alone; nothing is loaded from here.
 * docs/reference/live.md defines what comes from the master.
 *
 * @typedef {[number, number, number]} Vec3
 *
 * @typedef {object} Cam  Camera as a hand moves it. Degrees and mm.
 * @property {number} azimuth    from the front, towards the positive side axis
 * @property {number} elevation  -90 to 90, towards up
 * @property {number} roll       turn of the picture, clockwise
 * @property {Vec3} target       point that the eye looks at, world mm
 * @property {number} height     world height shown at the target, mm
 * @property {"ortho"|"persp"} projection
 * @property {number} fov        vertical field of view in degrees, of "persp"
 *
 * @typedef {object} Axes  How a volume stands, as unit vectors of the world.
 * @property {Vec3} up
 * @property {Vec3} front
 * @property {Vec3} side   the axis that is neither up nor front, positive
 * @property {1|-1} hand   sign of side . (front x up)
 *
 * @typedef {object} Shading
 * @property {boolean} on
 * @property {number} ambient
 * @property {number} diffuse
 * @property {number} specular
 * @property {number} power
 * @property {"key"|"head"|Vec3} light
 *
 * @typedef {object} Tf  A transfer function (docs/reference/transfer-functions.md), over values.
 * @property {number} version
 * @property {"value"|"unit"} domain
 * @property {number[][]} colors            [x, r, g, b]
 * @property {number[][]} opacities         [x, opacity]
 * @property {number[][]} [gradient_opacity] [magnitude, factor]
 * @property {"srgb"|"linear"} [color_space]
 * @property {string} [opacity_unit]
 * @property {{color: number[], opacity: number}} [nan]
 * @property {Shading} [shading]
 *
 * @typedef {[number|null, number|null][]} CropEnds  Ends along x, y, z in world mm; null: not cut.
 *
 * @typedef {object} Stop  A key of a movie.
 * @property {Cam} cam
 * @property {Tf|string} tf
 *
 * @typedef {object} Film  What the movie form holds.
 * @property {"turn"|"keys"} kind
 * @property {number} degrees
 * @property {number} seconds
 * @property {number} fps
 * @property {string} format
 * @property {Stop[]} keys
 *
 * @typedef {object} State  Everything that a picture follows from. Never changed in place.
 * @property {string} volume
 * @property {string} digest
 * @property {Cam} cam
 * @property {string|null} up      other than the volume's
 * @property {string|null} front
 * @property {string|null} preset  name, while the function is the preset's own
 * @property {Tf} tf
 * @property {CropEnds} crop
 * @property {string} background   #rrggbb
 * @property {{error?: number, budget_ms?: number}} quality
 * @property {Film} film
 *
 * @typedef {object} Preset
 * @property {string} name
 * @property {string} for
 * @property {number} share
 * @property {boolean} [map]
 * @property {Tf} tf
 *
 * @typedef {object} Volume  The message `volume`.
 * @property {string} name
 * @property {string} digest
 * @property {string} file
 * @property {number[]} dims
 * @property {Vec3[]} steps
 * @property {[Vec3, Vec3]} box
 * @property {string} unit
 * @property {boolean} anatomical
 * @property {string} up
 * @property {string} front
 * @property {string} sample_kind
 * @property {[number, number]} range
 * @property {[number, number]} core
 * @property {{from: number, to: number, counts: number[]}} histogram
 * @property {{to: number, counts: number[]}|null} gradients
 * @property {boolean} hounsfield
 * @property {number} nan
 * @property {Preset[]} presets
 * @property {{camera: object, tf: string|Tf}} home
 *
 * @typedef {object} Tile  A binary message, taken apart.
 * @property {number} kind
 * @property {boolean} still
 * @property {boolean} first
 * @property {boolean} thumb
 * @property {number} seq
 * @property {number} scene
 * @property {number} x
 * @property {number} y
 * @property {number} w
 * @property {number} h
 * @property {number} fullW
 * @property {number} fullH
 * @property {number} bound
 * @property {Uint8Array<ArrayBuffer>} data
 */
export {};
