//! Turns normals of other renderers into those of Cycles' Denoising Normal: in camera space, x to the right,
//! y up, z away from the camera, in -1..1.
//!
//! How a file stores them is found out from the values, since every surface that is seen faces the camera.
//! Where nearly every normal points against the ray through its pixel, they are in camera space already.
//! Otherwise they are in world space, and are turned by the camera's matrix where the file has it (OpenEXR's
//! `worldToCamera`), or else by the viewing direction that the normals of the surfaces face best.

use std::fmt;

use crate::{kernels::thirds, planes::Planes};

/// A vector.
type Vec3 = [f32; 3];

/// What was done to normals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Change {
    /// They were stored in 0..1.
    pub was_unit_range: bool,
    /// The way they were turned.
    pub turn: Turn,
}

/// How normals had to be turned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Turn {
    /// They were in Cycles' camera space.
    None,
    /// In camera space with z towards the camera.
    TowardsCamera,
    /// In camera space, all of them pointing inwards.
    Inwards,
    /// In world space, turned by the camera's matrix.
    ByMatrix,
    /// In world space, turned by the viewing direction that the normals tell.
    BySight,
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let range = if self.was_unit_range { "stored in 0..1, " } else { "" };
        let (space, done) = match self.turn {
            Turn::None => ("in camera space", "used so"),
            Turn::TowardsCamera => ("in camera space with z towards the camera", "z is turned round"),
            Turn::Inwards => ("pointing inwards", "turned round"),
            Turn::ByMatrix => ("in world space", "turned into camera space by the file's worldToCamera"),
            Turn::BySight => (
                "in world space",
                "turned into camera space as far as the picture tells (an attribute worldToCamera says it exactly)",
            ),
        };
        write!(f, "normals are {range}{space}: {done}")
    }
}

/// Lengths of normals in pixels that show one surface, and not a mixture of several.
const UNIT: std::ops::Range<f32> = 0.9..1.1;
/// The share of the normals that must face the camera for them to be in camera space. The others may lie on
/// silhouettes and in mirrors.
const FACING: f64 = 0.97;
/// Half the horizontal field of view of a usual camera, as a tangent: 53 degrees across.
const HALF_FIELD: f32 = 0.5;
/// How far a normal may point away from the camera and still count as facing it, since other lenses and
/// interpolated normals make as much of a difference.
const GRAZING: f32 = 0.05;
/// The share of the normals that must be of unit length when read as 0..1 for that to be their range.
const MOST: f64 = 0.5;

/// Turns (3, H, W) normals of any renderer into those of Cycles. `world_to_camera` is OpenEXR's attribute of
/// that name, by rows: vectors are multiplied from the left. Returns what was done; none where no pixel has a
/// normal to tell by.
pub fn to_camera_space(normals: &mut Planes, world_to_camera: Option<[f32; 16]>) -> Option<Change> {
    let was_unit_range = is_unit_range(normals);
    if was_unit_range {
        each(normals, |n| {
            let n = n.map(|v| 2.0 * v - 1.0);
            // Pixels that were black, where nothing is seen, stay without a normal.
            if length(n) > 1.5 { [0.0; 3] } else { n }
        });
    }
    let seen: Vec<Vec3> = surfaces(normals).collect();
    if seen.is_empty() {
        return None;
    }
    let rows = world_to_camera.and_then(rotation);
    let of_world = if rows.is_some() { Turn::ByMatrix } else { Turn::BySight };
    let turn = seen_from(normals).unwrap_or(of_world);
    match (turn, rows) {
        (Turn::None, _) => {}
        (Turn::TowardsCamera, _) => each(normals, |[x, y, z]| [x, y, -z]),
        (Turn::Inwards, _) => each(normals, |n| n.map(|v| -v)),
        (Turn::ByMatrix, Some(rows)) => {
            let turned = |n: Vec3| [0, 1, 2].map(|axis| (0..3).map(|i| n[i] * rows[i][axis]).sum::<f32>());
            // Renderers differ in whether their cameras look along z or against it.
            let behind = seen.iter().filter(|n| turned(**n)[2] > 0.0).count() * 2 > seen.len();
            each(normals, |n| {
                let [x, y, z] = turned(n);
                [x, y, if behind { -z } else { z }]
            });
        }
        (Turn::ByMatrix | Turn::BySight, _) => {
            let axes = camera_axes(&seen);
            each(normals, |n| axes.map(|axis| dot(axis, n)));
        }
    }
    Some(Change { was_unit_range, turn })
}

/// Changes every normal.
fn each(normals: &mut Planes, change: impl Fn(Vec3) -> Vec3) {
    let [x, y, z] = thirds(&mut normals.data);
    for ((x, y), z) in x.iter_mut().zip(y).zip(z) {
        [*x, *y, *z] = change([*x, *y, *z]);
    }
}

/// The normals of pixels that show something.
fn all(normals: &Planes) -> impl Iterator<Item = Vec3> + '_ {
    let area = normals.width * normals.height;
    (0..area).map(move |i| [0, 1, 2].map(|axis| normals.data[axis * area + i])).filter(|n| *n != [0.0; 3])
}

/// The normals of pixels that show one surface.
fn surfaces(normals: &Planes) -> impl Iterator<Item = Vec3> + '_ {
    all(normals).filter(|n| UNIT.contains(&length(*n)))
}

/// Whether normals are stored in 0..1, as colours are: none is negative, and most are of unit length if read
/// so.
fn is_unit_range(normals: &Planes) -> bool {
    if normals.data.iter().any(|v| *v < -0.01) {
        return false;
    }
    let (mut of_unit, mut decoded, mut count) = (0usize, 0usize, 0usize);
    for n in all(normals) {
        count += 1;
        of_unit += usize::from(UNIT.contains(&length(n)));
        decoded += usize::from(UNIT.contains(&length(n.map(|v| 2.0 * v - 1.0))));
    }
    decoded > of_unit && decoded as f64 > MOST * count as f64
}

/// How normals in camera space are to be turned; none where they are not in camera space.
fn seen_from(normals: &Planes) -> Option<Turn> {
    let (width, height) = (normals.width, normals.height);
    let (mut away, mut towards, mut count, mut up) = (0usize, 0usize, 0usize, 0.0);
    for i in 0..width * height {
        let [x, y, z] = [0, 1, 2].map(|axis| normals.data[axis * width * height + i]);
        if !UNIT.contains(&length([x, y, z])) {
            continue;
        }
        // The ray through the pixel, for z away from the camera.
        let half = width as f32 / 2.0;
        let right = ((i % width) as f32 + 0.5 - half) / half;
        let above = (height as f32 / 2.0 - (i / width) as f32 - 0.5) / half;
        let ray = unit([HALF_FIELD * right, HALF_FIELD * above, 1.0]);
        away += usize::from(dot([x, y, z], ray) < GRAZING);
        towards += usize::from(dot([x, y, -z], ray) < GRAZING);
        up += y;
        count += 1;
    }
    let is_most = |facing: usize| facing as f64 >= FACING * count as f64;
    if is_most(away) {
        return Some(Turn::None);
    }
    // Floors are seen more than ceilings, so normals that mostly point down point inwards. A frame of nothing
    // but ceiling is even rarer than such normals.
    let turn = if up < -0.2 * count as f32 { Turn::Inwards } else { Turn::TowardsCamera };
    is_most(towards).then_some(turn)
}

/// The rows of the matrix's rotation, each of length one; none where it is not a rotation.
fn rotation(matrix: [f32; 16]) -> Option<[Vec3; 3]> {
    let rows = [0, 1, 2].map(|i| [0, 1, 2].map(|j| matrix[4 * i + j]));
    let is_row = |row: &Vec3| length(*row).is_finite() && length(*row) > 1e-6;
    let rows = rows.iter().all(is_row).then(|| rows.map(|row| row.map(|v| v / length(row))))?;
    let is_square = (0..3).all(|i| dot(rows[i], rows[(i + 1) % 3]).abs() < 1e-2);
    is_square.then_some(rows)
}

/// The most that a normal that faces a direction counts for it, so that floors seen at a slant tell as much
/// as walls seen straight on.
const SLANT: f32 = 0.2;
/// How many directions are tried as the camera's.
const DIRECTIONS: usize = 2000;
/// The most normals that are looked at.
const SAMPLE: usize = 4096;

/// The camera's axes in the world (right, up, forward), as far as the normals of what it sees tell. Forward
/// is the direction against which most of them face. Up is the y or the z of the world, whichever more
/// normals point along.
fn camera_axes(seen: &[Vec3]) -> [Vec3; 3] {
    let sample: Vec<Vec3> = seen.iter().step_by(seen.len().div_ceil(SAMPLE)).copied().collect();
    let facing = |forward: Vec3| sample.iter().map(|n| (-dot(*n, forward)).min(SLANT)).sum::<f32>();
    let mut scored: Vec<(f32, Vec3)> = sphere().map(|forward| (facing(forward), forward)).collect();
    // Many directions do equally well where little is seen, so the mean of the best is taken.
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    let best = scored[..20].iter().fold([0.0; 3], |sum, (_, f)| [0, 1, 2].map(|i| sum[i] + f[i]));
    let forward = unit(best);
    let flat = |axis: usize| sample.iter().filter(|n| n[axis] > 0.9).count();
    let mut up = [0.0; 3];
    up[if flat(1) > flat(2) { 1 } else { 2 }] = 1.0;
    // For a camera that looks straight down or up, any direction may be its right.
    let side = cross(forward, up);
    let right = if length(side) > 0.05 { unit(side) } else { [1.0, 0.0, 0.0] };
    [right, cross(right, forward), forward]
}

/// Directions all over the sphere, evenly: a Fibonacci spiral.
fn sphere() -> impl Iterator<Item = Vec3> {
    let golden = std::f32::consts::PI * (1.0 + 5.0f32.sqrt());
    (0..DIRECTIONS).map(move |i| {
        let i = i as f32 + 0.5;
        let z = 1.0 - 2.0 * i / DIRECTIONS as f32;
        let (sin, cos) = (golden * i).sin_cos();
        let r = (1.0 - z * z).sqrt();
        [r * cos, r * sin, z]
    })
}

fn dot(a: Vec3, b: Vec3) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn length(v: Vec3) -> f32 {
    dot(v, v).sqrt()
}

fn unit(v: Vec3) -> Vec3 {
    let length = length(v).max(f32::MIN_POSITIVE);
    v.map(|v| v / length)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera that looks a little down and to the side, in a world whose z is up: right, up, forward.
    fn camera() -> [Vec3; 3] {
        let forward = unit([0.5, 0.8, -0.3]);
        let right = unit(cross(forward, [0.0, 0.0, 1.0]));
        [right, cross(right, forward), forward]
    }

    /// A floor, two walls and a ball before them, as Cycles' camera sees them.
    fn room() -> Planes {
        let axes = camera();
        let (width, height) = (48, 32);
        let mut planes = Planes::from_vec(3, width, height, vec![0.0; 3 * width * height]);
        for y in 0..height {
            for x in 0..width {
                let (u, v) = ((x as f32 - 24.0) / 12.0, (16.0 - y as f32) / 12.0);
                let world = |n: Vec3| axes.map(|axis| dot(axis, n));
                let n = if u * u + v * v < 0.8 {
                    [u, v, -(1.0 - u * u - v * v).sqrt()]
                } else if v < 0.2 {
                    world([0.0, 0.0, 1.0])
                } else if u < 0.0 {
                    world([0.0, -1.0, 0.0])
                } else {
                    world([-1.0, 0.0, 0.0])
                };
                (0..3).for_each(|c| planes.data[(c * height + y) * width + x] = n[c]);
            }
        }
        planes
    }

    fn changed(change: impl Fn(Vec3) -> Vec3) -> Planes {
        let mut planes = room();
        each(&mut planes, change);
        planes
    }

    fn into_world(n: Vec3) -> Vec3 {
        let axes = camera();
        [0, 1, 2].map(|i| (0..3).map(|c| axes[c][i] * n[c]).sum())
    }

    /// The mean angle in degrees between the normals that were found and the true ones.
    fn off(got: &Planes) -> f32 {
        let truth = room();
        let angles = all(got).zip(all(&truth)).map(|(a, b)| dot(a, b).clamp(-1.0, 1.0).acos().to_degrees());
        angles.sum::<f32>() / (got.width * got.height) as f32
    }

    #[test]
    fn what_is_as_cycles_has_it_stays() {
        let mut planes = room();
        let change = to_camera_space(&mut planes, None).unwrap();
        assert_eq!(change, Change { was_unit_range: false, turn: Turn::None });
        assert_eq!(planes, room());
    }

    #[test]
    fn ranges_and_directions_are_put_right() {
        let cases: [(Planes, bool, Turn); 4] = [
            (changed(|n| n.map(|v| 0.5 * v + 0.5)), true, Turn::None),
            (changed(|[x, y, z]| [x, y, -z]), false, Turn::TowardsCamera),
            (changed(|n| n.map(|v| -v)), false, Turn::Inwards),
            (changed(|[x, y, z]| [0.5 * x + 0.5, 0.5 * y + 0.5, 0.5 - 0.5 * z]), true, Turn::TowardsCamera),
        ];
        for (mut planes, was_unit_range, turn) in cases {
            assert_eq!(to_camera_space(&mut planes, None), Some(Change { was_unit_range, turn }));
            assert!(off(&planes) < 0.1, "{turn:?}: {}", off(&planes));
        }
    }

    #[test]
    fn the_world_is_turned_by_the_matrix_or_by_what_is_seen() {
        let axes = camera();
        // Vectors from the left: a column for each of the camera's axes.
        let mut matrix = [0.0; 16];
        for (column, axis) in axes.iter().enumerate() {
            (0..3).for_each(|row| matrix[4 * row + column] = 2.0 * axis[row]);
        }
        let mut against = matrix;
        (0..3).for_each(|row| against[4 * row + 2] *= -1.0);
        for matrix in [matrix, against] {
            let mut planes = changed(into_world);
            let change = to_camera_space(&mut planes, Some(matrix)).unwrap();
            assert_eq!(change.turn, Turn::ByMatrix);
            assert!(off(&planes) < 0.1, "{}", off(&planes));
        }
        let mut planes = changed(into_world);
        let wrong = off(&planes);
        let change = to_camera_space(&mut planes, None).unwrap();
        assert_eq!(change.turn, Turn::BySight);
        assert!(wrong > 60.0 && off(&planes) < 25.0, "{wrong} {}", off(&planes));
        // A matrix that is none.
        let mut planes = changed(into_world);
        assert_eq!(to_camera_space(&mut planes, Some([0.0; 16])).unwrap().turn, Turn::BySight);
    }

    #[test]
    fn black_tells_nothing() {
        let mut planes = Planes::from_vec(3, 2, 2, vec![0.0; 12]);
        assert_eq!(to_camera_space(&mut planes, None), None);
    }
}
