//! Solves small symmetric positive systems, [`LANES`] of them at once, one in each lane, by Cholesky
//! factorisation with a ridge that keeps every system solvable.

/// Systems solved together.
pub const LANES: usize = 16;

/// One value of each of the systems.
pub type Lanes = [f32; LANES];

/// `sum + a * b` in each lane. Arrays are passed and returned by value, so that compilers see one vector;
/// loops over memory became gathers.
#[inline(always)]
pub fn plus_product(mut sum: Lanes, a: Lanes, b: Lanes) -> Lanes {
    for l in 0..LANES {
        sum[l] += a[l] * b[l];
    }
    sum
}

/// `sum - a * b` in each lane.
#[inline(always)]
fn minus_product(mut sum: Lanes, a: Lanes, b: Lanes) -> Lanes {
    for l in 0..LANES {
        sum[l] -= a[l] * b[l];
    }
    sum
}

/// `a * b` in each lane.
#[inline(always)]
pub fn product(mut a: Lanes, b: Lanes) -> Lanes {
    for l in 0..LANES {
        a[l] *= b[l];
    }
    a
}

/// `a - b` in each lane.
#[inline(always)]
pub fn difference(mut a: Lanes, b: Lanes) -> Lanes {
    for l in 0..LANES {
        a[l] -= b[l];
    }
    a
}

/// Smallest pivot as a share of the diagonal value it came from. Below it, the unknown already follows from
/// the others, up to rounding.
const MIN_PIVOT: f32 = 1e-5;

/// Where (row, column) of a lower triangle is stored.
fn at(row: usize, column: usize) -> usize {
    row * (row + 1) / 2 + column
}

/// The lower triangles of symmetric matrices, row by row.
pub struct Symmetric {
    size: usize,
    values: Vec<Lanes>,
}

impl Symmetric {
    /// Matrices of `size` rows, whose lower triangles `values` holds row by row.
    ///
    /// # Panics
    /// If there are not as many values.
    pub fn of(size: usize, values: Vec<Lanes>) -> Self {
        assert_eq!(values.len(), at(size, 0));
        Self { size, values }
    }

    /// Zero matrices.
    pub fn new(size: usize) -> Self {
        Self { size, values: vec![[0.0; LANES]; at(size, 0)] }
    }

    /// Makes them zero again.
    #[inline(always)]
    pub fn clear(&mut self) {
        self.values.fill([0.0; LANES]);
    }

    /// Adds `weight * v v^T`; `weighted` is `weight * v`.
    #[inline(always)]
    pub fn add_outer(&mut self, weighted: &[Lanes], v: &[Lanes]) {
        let mut values = self.values.iter_mut();
        for (row, a) in weighted.iter().enumerate() {
            for (b, sum) in v[..=row].iter().zip(&mut values) {
                *sum = plus_product(*sum, *a, *b);
            }
        }
    }

    /// Adds to each diagonal value but the first `relative` times itself and `absolute` times the
    /// first: a prior that slopes are small, in units of the sum of weights.
    #[inline(always)]
    pub fn ridge(&mut self, relative: f32, absolute: Lanes) {
        let first = self.values[0];
        for i in 1..self.size {
            let diagonal = &mut self.values[at(i, i)];
            for l in 0..LANES {
                diagonal[l] += relative * diagonal[l] + absolute[l] * first[l];
            }
        }
    }

    /// Turns the matrices into their Cholesky factors L, with the inverse of the diagonal on it. A zero
    /// matrix gives zero solutions.
    #[inline(always)]
    pub fn factor(&mut self) {
        for i in 0..self.size {
            for j in 0..=i {
                let mut sum = self.values[at(i, j)];
                let before = sum;
                for k in 0..j {
                    sum = minus_product(sum, self.values[at(i, k)], self.values[at(j, k)]);
                }
                if i == j {
                    for l in 0..LANES {
                        let pivot = sum[l].max(before[l] * MIN_PIVOT);
                        sum[l] = if pivot > f32::MIN_POSITIVE { pivot.sqrt().recip() } else { 0.0 };
                    }
                } else {
                    sum = product(sum, self.values[at(j, j)]);
                }
                self.values[at(i, j)] = sum;
            }
        }
    }

    /// `L^-1 v` in place, after [`Symmetric::factor`].
    #[inline(always)]
    pub fn forward(&self, v: &mut [Lanes]) {
        for i in 0..self.size {
            let mut sum = v[i];
            for (k, b) in v[..i].iter().enumerate() {
                sum = minus_product(sum, self.values[at(i, k)], *b);
            }
            v[i] = product(sum, self.values[at(i, i)]);
        }
    }

    /// `L^-T v` in place.
    #[inline(always)]
    fn backward(&self, v: &mut [Lanes]) {
        for i in (0..self.size).rev() {
            let mut sum = v[i];
            for (k, b) in v[..self.size].iter().enumerate().skip(i + 1) {
                sum = minus_product(sum, self.values[at(k, i)], *b);
            }
            v[i] = product(sum, self.values[at(i, i)]);
        }
    }

    /// The solutions for the right-hand sides `v`, in place, after [`Symmetric::factor`].
    #[inline(always)]
    pub fn solve(&self, v: &mut [Lanes]) {
        self.forward(v);
        self.backward(v);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filters::variance::tests::noise;

    #[test]
    fn solves_each_lane_its_own_system() {
        const N: usize = 5;
        let mut a = Symmetric::new(N);
        let random = noise(3, N * N * LANES * 2, 1.0);
        let rows: Vec<[Lanes; N]> = (0..2 * N)
            .map(|r| std::array::from_fn(|i| std::array::from_fn(|l| random[(r * N + i) * LANES + l])))
            .collect();
        for row in &rows {
            a.add_outer(row, row);
        }
        let x: [Lanes; N] = std::array::from_fn(|i| [i as f32 - 1.5; LANES]);
        // b = A x, straight from A = sum of rows' outer products.
        let mut b = [[0.0; LANES]; N];
        for row in &rows {
            for l in 0..LANES {
                let dot: f32 = (0..N).map(|i| row[i][l] * x[i][l]).sum();
                (0..N).for_each(|i| b[i][l] += row[i][l] * dot);
            }
        }
        a.factor();
        a.solve(&mut b);
        for i in 0..N {
            for l in 0..LANES {
                assert!((b[i][l] - x[i][l]).abs() < 1e-2, "{i} {l}: {} {}", b[i][l], x[i][l]);
            }
        }
    }

    #[test]
    fn singular_systems_have_finite_solutions() {
        let mut a = Symmetric::new(3);
        // Lane 0 stays zero; the others have two equal unknowns.
        let mut v = [[1.0; LANES], [2.0; LANES], [2.0; LANES]];
        v.iter_mut().for_each(|v| v[0] = 0.0);
        a.add_outer(&v, &v);
        a.ridge(1e-4, [1e-4; LANES]);
        a.factor();
        let mut b = [[3.0; LANES]; 3];
        a.solve(&mut b);
        assert!(b.iter().flatten().all(|v| v.is_finite()), "{b:?}");
        assert!(b.iter().all(|b| b[0] == 0.0), "{b:?}");
    }
}
