/** Programs of the bending. Pixel (0, 0) is the centre of the top left one; textures have its row first. */

/** A corner per map pixel, moved to where its depth puts it in the wanted pose. */
export const MESH_VERTEX_SHADER = `#version 300 es
precision highp float;
uniform sampler2D map;
uniform ivec2 grid;
uniform vec2 size;
uniform vec4 source, target;
uniform mat3 rotation;
uniform vec3 shift;
uniform float nearest;
out vec2 place;
out float tear;

float inverseDepth(ivec2 cell) {
  return texelFetch(map, clamp(cell, ivec2(0), grid - 1), 0).r * nearest;
}

void main() {
  ivec2 cell = ivec2(gl_VertexID % grid.x, gl_VertexID / grid.x);
  float inverse = inverseDepth(cell);
  // Map pixels are every third of the picture's; the outermost corners reach to its edges.
  vec2 pixel = vec2(cell) * 3.0 + 1.0;
  pixel = mix(pixel, vec2(-0.5), equal(cell, ivec2(0)));
  pixel = mix(pixel, size - 0.5, equal(cell, grid - 1));
  vec3 ray = vec3((pixel - source.zw) / source.xy, 1.0);
  vec3 point = rotation * ray + shift * inverse;
  vec2 moved = target.xy * point.xy / point.z + target.zw;
  float step = 0.0;
  for (int i = 0; i < 4; i++) {
    ivec2 way = ivec2(i == 0 ? 1 : i == 1 ? -1 : 0, i == 2 ? 1 : i == 3 ? -1 : 0);
    step = max(step, abs(inverseDepth(cell + way) - inverse));
  }
  // How far apart, in pixels of the wanted view, neighbours on two surfaces come to lie.
  tear = step * length(shift.xy) * target.x;
  place = (pixel + 0.5) / size;
  float nearness = clamp(inverse / point.z / (2.0 * nearest), 0.0, 1.0);
  vec2 clip = (moved + 0.5) / size * 2.0 - 1.0;
  gl_Position = vec4(clip * point.z, (1.0 - 2.0 * nearness) * point.z, point.z);
}`;

/** Where the mesh is torn open it weighs little, so that the other view fills in. */
export const MESH_FRAGMENT_SHADER = `#version 300 es
precision highp float;
uniform sampler2D picture;
in vec2 place;
in float tear;
out vec4 colour;

void main() {
  colour = vec4(texture(picture, place).rgb, mix(1.0, 0.02, smoothstep(1.0, 2.5, tear)));
}`;

export const FULL_SHADER = `#version 300 es
out vec2 place;

void main() {
  vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  place = corner * 0.5 + 0.5;
  gl_Position = vec4(corner, 0.0, 1.0);
}`;

export const BLEND_SHADER = `#version 300 es
precision highp float;
uniform sampler2D first, second, bentFirst, bentSecond;
uniform float weight;
uniform bool isBent;
in vec2 place;
out vec4 colour;

void main() {
  // The screen has its first row below.
  vec2 upright = vec2(place.x, 1.0 - place.y);
  vec4 a = vec4(texture(first, upright).rgb, 1.0);
  vec4 b = vec4(texture(second, upright).rgb, 1.0);
  if (isBent) {
    vec4 bentA = texture(bentFirst, upright);
    vec4 bentB = texture(bentSecond, upright);
    if (bentA.a + bentB.a > 0.0) {
      a = bentA;
      b = bentB;
    }
  }
  float p = a.a * (1.0 - weight), q = b.a * weight;
  colour = vec4((a.rgb * p + b.rgb * q) / max(p + q, 1e-6), 1.0);
}`;
