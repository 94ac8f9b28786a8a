//! Where the content of a frame lies in other frames of its sequence, and planes sampled there.
//!
//! In: Vector passes as Cycles writes them. They count rows upwards and frames point at both neighbours: with
//! rows counted downwards, what is at (x, y) was at (x + X, y - Y) one frame before. One frame later it will
//! be at (x - Z, y + W). Steps can be chained: each uses the vectors of the frame in which the step before it
//! ended. Vectors are those of the surface that the camera sees first; what mirrors and glass show, and
//! shadows, move otherwise.

use rayon::prelude::*;

use crate::{
    kernels::{
        memory::PlaneBuffer,
        vectorised::{self, Vectorised},
    },
    planes::Planes,
};

/// A direction in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// To the frame before.
    Back,
    /// To the frame after.
    Forth,
}

/// For every pixel of a frame, where its content lies in another; NaN where that is outside of it.
#[derive(Clone, Debug)]
pub struct Flow {
    width: usize,
    height: usize,
    /// The column for every pixel, then the row for every pixel. 0 is the centre of the first column or row.
    at: PlaneBuffer,
}

/// Half a pixel: frames reach that far beyond the centres of their outermost pixels.
const MARGIN: f32 = 0.5;

impl Flow {
    /// From a frame to itself.
    pub fn still(width: usize, height: usize) -> Self {
        let at = Planes::from_rows(2, (width, height), |c, y, out| {
            out.iter_mut().enumerate().for_each(|(x, out)| *out = if c == 0 { x as f32 } else { y as f32 });
        });
        Self { width, height, at: at.data }
    }

    /// Extends the flow by one frame. `vectors`, (4, H, W), are those of the frame in which it ended so far.
    ///
    /// # Panics
    /// If the vectors are of another size.
    pub fn step(&mut self, vectors: &Planes, direction: Direction) {
        let (width, height) = (self.width, self.height);
        assert_eq!(vectors.extent(), (4, width, height), "a pass of the frame");
        let (right, up, sign) = match direction {
            Direction::Back => (0, 1, 1.0),
            Direction::Forth => (2, 3, -1.0),
        };
        let (right, up) = (vectors.channel(right), vectors.channel(up));
        let (columns, rows) = self.at.split_at_mut(width * height);
        columns.par_iter_mut().zip(rows).with_min_len(width).for_each(|(x, y)| {
            // The nearest pixel: between two surfaces, a mean of their vectors would lead to neither.
            let Some(from) = nearest((*x, *y), (width, height)) else { return };
            *x += sign * right[from];
            *y -= sign * up[from];
            if nearest((*x, *y), (width, height)).is_none() {
                (*x, *y) = (f32::NAN, f32::NAN);
            }
        });
    }

    /// Pixels in a row, and rows.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// Columns and rows of the places in one row of pixels.
    pub fn row(&self, y: usize) -> (&[f32], &[f32]) {
        let (columns, rows) = self.at.split_at(self.width * self.height);
        (&columns[y * self.width..][..self.width], &rows[y * self.width..][..self.width])
    }

    /// The pixels of the other frame that are [`nearest`] to the places of a row of pixels of this one, as
    /// stretches of a row in both; pixels whose place is outside are in none.
    ///
    /// # Panics
    /// If the frame has more pixels than 32 bits count.
    pub fn nearest_of_row(&self, y: usize) -> Vec<Stretch> {
        assert!(u32::try_from(self.width * self.height).is_ok_and(|n| n < OUTSIDE), "a frame");
        let (columns, rows) = self.row(y);
        let mut nearest = vec![OUTSIDE; self.width];
        vectorised::run(NearestOfRow { columns, rows, size: self.size(), out: &mut nearest });
        let mut stretches = Vec::new();
        let mut begins = 0;
        for pixels in nearest.chunk_by(|here, next| *here != OUTSIDE && *next == here + 1) {
            if pixels[0] != OUTSIDE {
                stretches.push(Stretch { here: begins, there: pixels[0] as usize, pixels: pixels.len() });
            }
            begins += pixels.len();
        }
        stretches
    }

    /// Planes of the other frame, sampled bilinearly at the place of each pixel of this one. Places outside
    /// of that frame give NaN.
    ///
    /// # Panics
    /// If the planes are of another size.
    pub fn bilinear(&self, planes: &Planes) -> Planes {
        assert_eq!((planes.width, planes.height), self.size(), "frames of one size");
        Planes::from_rows(planes.channels, self.size(), |c, y, out| {
            let (columns, rows) = self.row(y);
            let plane = planes.channel(c);
            for (out, (x, y)) in out.iter_mut().zip(columns.iter().zip(rows)) {
                *out = Between::new((*x, *y), self.size()).of(plane);
            }
        })
    }
}

/// The index of the pixel at a place, if it is inside of a frame.
pub fn nearest((x, y): (f32, f32), (width, height): (usize, usize)) -> Option<usize> {
    let inside = |v: f32, n: usize| v >= -MARGIN && v < n as f32 - MARGIN;
    (inside(x, width) && inside(y, height)).then(|| {
        let [column, row] = [(x, width), (y, height)].map(|(v, n)| ((v + MARGIN) as usize).min(n - 1));
        row * width + column
    })
}

/// Pixels that lie side by side in a row of a frame and in another frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stretch {
    /// The first one's column.
    pub here: usize,
    /// Its index in the other frame.
    pub there: usize,
    /// How many there are.
    pub pixels: usize,
}

impl Stretch {
    /// The part of a row of values that lies in the stretch.
    pub fn of<'a>(&self, row: &'a [f32]) -> &'a [f32] {
        &row[self.here..][..self.pixels]
    }

    /// Likewise, writable.
    pub fn of_mut<'a>(&self, row: &'a mut [f32]) -> &'a mut [f32] {
        &mut row[self.here..][..self.pixels]
    }

    /// Its values in a plane of the other frame.
    pub fn of_other<'a>(&self, plane: &'a [f32]) -> &'a [f32] {
        &plane[self.there..][..self.pixels]
    }
}

/// The index of a pixel that no frame has.
const OUTSIDE: u32 = u32::MAX;

/// The index of the pixel nearest to each place of a row, [`OUTSIDE`] where that is outside.
struct NearestOfRow<'a> {
    columns: &'a [f32],
    rows: &'a [f32],
    size: (usize, usize),
    out: &'a mut [u32],
}

impl Vectorised for NearestOfRow<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { columns, rows, size: (width, height), out } = self;
        for (out, (x, y)) in out.iter_mut().zip(columns.iter().zip(rows)) {
            let is_inside =
                *x >= -MARGIN && *x < width as f32 - MARGIN && *y >= -MARGIN && *y < height as f32 - MARGIN;
            let [column, row] =
                [(x, width), (y, height)].map(|(v, n)| ((v + MARGIN) as u32).min(n as u32 - 1));
            *out = if is_inside { row * width as u32 + column } else { OUTSIDE };
        }
    }
}

/// How far each pixel's place in a row is from the centre of the pixel nearest to it, in pixels; 0 for a place
/// of NaN.
pub struct Aside<'a> {
    /// Columns of the places.
    pub columns: &'a [f32],
    /// Rows of the places.
    pub rows: &'a [f32],
    /// The distances.
    pub out: &'a mut [f32],
}

impl Vectorised for Aside<'_> {
    #[inline(always)]
    fn run(self) {
        self.out.iter_mut().zip(self.columns.iter().zip(self.rows)).for_each(|(out, (x, y))| {
            let [x, y] = [*x, *y].map(|v| v - (v + MARGIN).floor());
            let distance = (x * x + y * y).sqrt();
            *out = if distance.is_nan() { 0.0 } else { distance };
        });
    }
}

/// The four pixels around a place, and how far it lies between them.
pub struct Between {
    corners: [[usize; 2]; 2],
    across: f32,
    down: f32,
}

impl Between {
    /// Of a place, where one of NaN gives values of NaN. Beyond the outermost pixels their values are repeated.
    pub fn new((x, y): (f32, f32), (width, height): (usize, usize)) -> Self {
        let (left, right, across) = between(x, width);
        let (above, below, down) = between(y, height);
        Self { corners: [above, below].map(|row| [left, right].map(|x| row * width + x)), across, down }
    }

    /// The value of a plane there.
    pub fn of(&self, plane: &[f32]) -> f32 {
        let [a, b] = self.corners.map(|[left, right]| {
            let (a, b) = (plane[left], plane[right]);
            a + (b - a) * self.across
        });
        a + (b - a) * self.down
    }
}

/// The two of `n` that a place lies between, and how far it is from the first.
fn between(v: f32, n: usize) -> (usize, usize, f32) {
    let v = v.clamp(0.0, (n - 1) as f32);
    let first = v as usize;
    (first, (first + 1).min(n - 1), v - first as f32)
}

/// As [`Between::of`], but of the first `N` planes and without blurring them. Values follow the cubic spline of Catmull
/// and Rom, kept between the least and the greatest of the four pixels around so that edges don't ring.
pub fn sharp<const N: usize>(planes: &Planes, (x, y): (f32, f32)) -> [f32; N] {
    let (width, height) = (planes.width, planes.height);
    let (columns, across) = spline(x, width);
    let (rows, down) = spline(y, height);
    std::array::from_fn(|c| {
        let plane = planes.channel(c);
        let (mut sums, mut least, mut greatest) = ([0.0; 4], f32::INFINITY, f32::NEG_INFINITY);
        for (j, (&row, down)) in rows.iter().zip(down).enumerate() {
            let line = &plane[row * width..][..width];
            // Far from the edges the four lie side by side.
            let near = line[columns[0]..].first_chunk().filter(|_| columns[3] == columns[0] + 3);
            let values: [f32; 4] = near.copied().unwrap_or_else(|| columns.map(|column| line[column]));
            sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += down * value);
            if j == 1 || j == 2 {
                least = least.min(values[1]).min(values[2]);
                greatest = greatest.max(values[1]).max(values[2]);
            }
        }
        let sum: f32 = sums.iter().zip(across).map(|(sum, weight)| sum * weight).sum();
        sum.clamp(least, greatest)
    })
}

/// The four of `n` around a place, and their weights.
fn spline(v: f32, n: usize) -> ([usize; 4], [f32; 4]) {
    let v = v.clamp(0.0, (n - 1) as f32);
    let first = v as usize;
    let t = v - first as f32;
    let at = [0, 1, 2, 3].map(|i| (first + i).saturating_sub(1).min(n - 1));
    let (squared, cubed) = (t * t, t * t * t);
    let weights = [
        -0.5 * t + squared - 0.5 * cubed,
        1.0 - 2.5 * squared + 1.5 * cubed,
        0.5 * t + 2.0 * squared - 1.5 * cubed,
        -0.5 * squared + 0.5 * cubed,
    ];
    (at, weights)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (24, 17);

    /// A smooth picture, (3, H, W), moved right by `dx` and down by `dy` pixels.
    fn picture((dx, dy): (f32, f32)) -> Planes {
        Planes::from_rows(3, SIZE, |c, y, out| {
            for (x, out) in out.iter_mut().enumerate() {
                let (x, y) = (x as f32 - dx, y as f32 - dy);
                *out = 1.0 + 0.5 * (0.3 * x + c as f32).sin() * (0.25 * y).cos();
            }
        })
    }

    /// The Vector pass of a picture that moves right by `dx` and down by `dy` pixels a frame.
    fn vectors((dx, dy): (f32, f32)) -> Planes {
        // It was at (x - dx, y - dy): X = -dx, Y = dy; it will be at (x + dx, y + dy): Z = -dx, W = dy.
        let values = [-dx, dy, -dx, dy];
        Planes::from_rows(4, SIZE, |c, _, out| out.fill(values[c]))
    }

    #[test]
    fn flows_follow_the_vectors_of_cycles_both_ways_and_chain() {
        let motion = (1.5, -0.75);
        for (direction, sign) in [(Direction::Back, -1.0), (Direction::Forth, 1.0)] {
            for frames in [1, 2] {
                let mut flow = Flow::still(SIZE.0, SIZE.1);
                (0..frames).for_each(|_| flow.step(&vectors(motion), direction));
                let by = sign * frames as f32;
                let other = picture((by * motion.0, by * motion.1));
                let (mut inside, here) = (0, picture((0.0, 0.0)));
                let sampled = flow.bilinear(&other);
                for y in 0..SIZE.1 {
                    let (columns, rows) = flow.row(y);
                    let want: Vec<_> =
                        columns.iter().zip(rows).map(|(x, y)| nearest((*x, *y), SIZE)).collect();
                    let mut found = [None; SIZE.0];
                    for Stretch { here, there, pixels } in flow.nearest_of_row(y) {
                        (0..pixels).for_each(|i| found[here + i] = Some(there + i));
                    }
                    assert_eq!(found[..], want);
                }
                for y in 1..SIZE.1 - 1 {
                    let (columns, rows) = flow.row(y);
                    for x in 1..SIZE.0 - 1 {
                        let (i, at) = (y * SIZE.0 + x, (columns[x], rows[x]));
                        // Splines need two pixels more around them.
                        let deep = |v: f32, n: usize| v > 1.0 && v < n as f32 - 2.0;
                        if !(deep(at.0, SIZE.0) && deep(at.1, SIZE.1)) {
                            continue;
                        }
                        inside += 1;
                        for (c, sharp) in sharp::<3>(&other, at).into_iter().enumerate() {
                            let want = here.channel(c)[i];
                            assert!((sampled.channel(c)[i] - want).abs() < 0.015, "{direction:?} {x} {y}");
                            assert!((sharp - want).abs() < 0.015, "{direction:?} {x} {y}");
                        }
                    }
                }
                assert!(inside > 200, "{inside}");
            }
        }
    }

    #[test]
    fn each_way_and_each_step_has_vectors_of_its_own() {
        // No two of all are alike, before column 12 and from there on.
        let vectors = Planes::from_rows(4, SIZE, |c, _, out| {
            let (left, right) = ([-1.0, 2.0, -3.0, 5.0][c], [-2.0, 4.0, 6.0, -1.0][c]);
            out.iter_mut().enumerate().for_each(|(x, out)| *out = if x < 12 { left } else { right });
        });
        let from = |place: (usize, usize), direction, steps| {
            let mut flow = Flow::still(SIZE.0, SIZE.1);
            (0..steps).for_each(|_| flow.step(&vectors, direction));
            let (columns, rows) = flow.row(place.1);
            (columns[place.0], rows[place.0])
        };
        assert_eq!(from((10, 8), Direction::Back, 1), (9.0, 6.0));
        assert_eq!(from((10, 8), Direction::Forth, 1), (13.0, 13.0));
        // The second step begins where the first one ends.
        assert_eq!(from((13, 8), Direction::Back, 2), (11.0 - 1.0, 4.0 - 2.0));
        assert_eq!(from((10, 3), Direction::Forth, 2), (13.0 - 6.0, 8.0 - 1.0));
    }

    #[test]
    fn what_leaves_the_frame_stays_away() {
        let mut flow = Flow::still(SIZE.0, SIZE.1);
        flow.step(&vectors((30.0, 0.0)), Direction::Forth);
        flow.step(&vectors((-30.0, 0.0)), Direction::Forth);
        assert!(flow.bilinear(&picture((0.0, 0.0))).data.iter().all(|v| v.is_nan()));
        assert!((0..SIZE.1).all(|y| flow.nearest_of_row(y).is_empty()));
        assert_eq!(nearest((-0.5, 0.0), SIZE), Some(0));
        assert_eq!(nearest((23.4, 16.4), SIZE), Some(SIZE.0 * SIZE.1 - 1));
        for outside in [(-0.6, 0.0), (0.0, -0.6), (23.5, 0.0), (0.0, 16.5), (f32::NAN, 0.0)] {
            assert_eq!(nearest(outside, SIZE), None, "{outside:?}");
        }
    }

    #[test]
    fn a_spline_keeps_what_lies_on_pixels_and_does_not_ring() {
        let step = Planes::from_rows(3, SIZE, |_, _, out| {
            out.iter_mut().enumerate().for_each(|(x, out)| *out = if x < 12 { 0.0 } else { 1.0 });
        });
        for x in 0..4 * (SIZE.0 - 1) {
            let x = x as f32 / 4.0;
            let [value] = sharp(&step, (x, 5.0));
            assert!((0.0..=1.0).contains(&value), "{value}");
            if x.fract() == 0.0 {
                assert_eq!(value, if x < 12.0 { 0.0 } else { 1.0 });
            }
        }
    }

    #[test]
    fn frames_of_one_pixel_are_sampled() {
        let one = Planes::from_vec(3, 1, 1, vec![1.0, 2.0, 3.0]);
        assert_eq!(sharp(&one, (0.3, -0.2)), [1.0, 2.0, 3.0]);
        assert_eq!(Between::new((0.3, 0.4), (1, 1)).of(one.channel(1)), 2.0);
    }
}
