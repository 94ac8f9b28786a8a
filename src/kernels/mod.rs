//! The arithmetic of networks and image filters: slices in, slices out, no type of the project.
//!
//! Activations of networks are stored channel-blocked and padded (NCHW16c): a [`Block`] is 16 consecutive
//! channels of one pixel, a plane is `(h + 2 pad) x (w + 2 pad)` blocks whose border is zero, and an image is
//! `ceil(c / 16)` planes. Lanes beyond `c` are zero in every activation. Images that are filtered are planar.
//! Values are f32; those of [`narrow`] convolutions have 16 or 8 bits.
//!
//! Each kernel is written once, generic over [`simd::Simd`]; the portable instance is the oracle of
//! the AVX2 and AVX-512 ones, and [`simd::Tier`] chooses among them once at run time.
//! This is the only module with `unsafe`.
#![allow(unsafe_code)]
// Loops over lanes and registers index several arrays at once; iterators would hide the arithmetic.
#![allow(clippy::needless_range_loop)]

pub mod blend;
pub mod conv;
pub mod cross_bilateral;
pub mod exponential;
pub mod filter;
pub mod gain;
pub mod heap;
pub mod layout;
pub mod logarithm;
pub mod memory;
pub mod narrow;
pub mod plane;
pub mod pool;
pub mod redivide;
pub mod simd;
pub mod vectorised;
pub mod weight_grad;
pub mod winograd;

use plane::Plane;

/// Channels in a [`Block`].
pub const LANES: usize = 16;

/// Sixteen channels of one pixel, aligned to a cache line so that no vector load straddles two.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub struct Block(pub [f32; LANES]);

/// The extent of a blocked activation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Shape {
    /// Images.
    pub n: usize,
    /// Channels.
    pub c: usize,
    /// Rows.
    pub h: usize,
    /// Pixels in a row.
    pub w: usize,
    /// Zero pixels around every plane: 1 serves 3x3 and transposed 4x4 convolutions, 2 serves 5x5.
    pub pad: usize,
}

impl Shape {
    /// A shape with a border of one pixel.
    pub fn new(n: usize, c: usize, h: usize, w: usize) -> Self {
        Self { n, c, h, w, pad: 1 }
    }

    /// The same pixels with other channels.
    pub fn with_channels(self, c: usize) -> Self {
        Self { c, ..self }
    }

    /// The same channels with other rows and columns.
    pub fn with_size(self, h: usize, w: usize) -> Self {
        Self { h, w, ..self }
    }

    /// The extent of an activation whose channels are the pixels of this one's quads, 2x2 pixels each (space
    /// to depth).
    ///
    /// # Panics
    /// If rows or columns are odd.
    pub fn quads(self) -> Self {
        assert!(self.h.is_multiple_of(2) && self.w.is_multiple_of(2), "only even sizes halve");
        self.with_channels(4 * self.c).with_size(self.h / 2, self.w / 2)
    }

    /// Planes of one image.
    pub fn planes(self) -> usize {
        self.c.div_ceil(LANES)
    }

    /// One plane.
    pub fn plane(self) -> Plane {
        Plane { h: self.h, w: self.w, pad: self.pad }
    }

    /// Blocks from one row to the next.
    pub fn row_stride(self) -> usize {
        self.plane().stride()
    }

    /// Blocks from one plane to the next.
    pub fn plane_stride(self) -> usize {
        self.plane().positions()
    }

    /// Blocks of the whole activation, borders included.
    ///
    /// # Panics
    /// If there are more than memory could hold.
    pub fn blocks(self) -> usize {
        let planes = self.n.checked_mul(self.planes());
        planes.and_then(|n| n.checked_mul(self.plane_stride())).expect("an activation fits into memory")
    }

    /// Channels in use in plane `plane`: 16, or fewer in the last.
    pub fn lanes(self, plane: usize) -> usize {
        (self.c - plane * LANES).min(LANES)
    }

    /// Index of the block at row `y`, column 0.
    pub fn row(self, n: usize, plane: usize, y: usize) -> usize {
        (n * self.planes() + plane) * self.plane_stride() + self.plane().row(y)
    }
}

/// A blocked activation to read.
#[derive(Clone, Copy)]
pub struct View<'a> {
    shape: Shape,
    /// `shape.blocks()` blocks.
    data: &'a [Block],
}

/// A blocked activation to write. Kernels write interiors only: borders stay as they are.
pub struct ViewMut<'a> {
    shape: Shape,
    /// `shape.blocks()` blocks.
    data: &'a mut [Block],
}

impl<'a> View<'a> {
    /// Pairs data with its shape.
    ///
    /// # Panics
    /// If the length differs from what the shape demands.
    pub fn new(shape: Shape, data: &'a [Block]) -> Self {
        assert_eq!(data.len(), shape.blocks(), "data must hold {shape:?}");
        Self { shape, data }
    }

    /// Its extent.
    pub fn shape(self) -> Shape {
        self.shape
    }

    /// As many blocks as its shape has.
    pub fn data(self) -> &'a [Block] {
        self.data
    }
}

impl<'a> ViewMut<'a> {
    /// Pairs data with its shape.
    ///
    /// # Panics
    /// If the length differs from what the shape demands.
    pub fn new(shape: Shape, data: &'a mut [Block]) -> Self {
        assert_eq!(data.len(), shape.blocks(), "data must hold {shape:?}");
        Self { shape, data }
    }

    /// Its extent.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// As many blocks as its shape has.
    pub fn data(&mut self) -> &mut [Block] {
        self.data
    }
}

/// The thirds of values, as the channels of an image, (3, H, W).
pub fn thirds<T>(values: &mut [T]) -> [&mut [T]; 3] {
    let (first, rest) = values.split_at_mut(values.len() / 3);
    let (second, third) = rest.split_at_mut(rest.len() / 2);
    [first, second, third]
}

/// A pointer that tasks share to write disjoint parts of one buffer.
#[derive(Clone, Copy)]
struct Shared(*mut Block);

// SAFETY: every kernel that shares one gives each task its own pixels or planes, so no two tasks
// ever touch the same block.
unsafe impl Send for Shared {}
// SAFETY: as above.
unsafe impl Sync for Shared {}

impl Shared {
    /// The pointer `offset` blocks on. A method, so that closures capture the whole wrapper.
    ///
    /// # Safety
    /// `offset` lies inside the buffer.
    unsafe fn at(self, offset: usize) -> *mut Block {
        // SAFETY: the caller's promise.
        unsafe { self.0.add(offset) }
    }
}
