//! Activations in the blocked layout, with a dfdx tape and a place for their gradient.

use std::sync::{Arc, Mutex, PoisonError};

use dfdx::tensor::{Cpu, NoneTape, PutTape, SplitTape, Tape, TensorFromVec};

use super::{Images, pool::Buffer, values_of};
use crate::kernels::{
    Shape, View,
    layout::{from_blocked, to_blocked},
    narrow::Operand,
};

/// The gradient of one activation or field while the tape runs backward; `None` until something is added. No
/// thread ever waits for the lock; it is there so that activations without a tape can move to another thread.
#[derive(Debug)]
pub(super) struct Gradient<B>(Arc<Mutex<Option<B>>>);

impl<B> Clone for Gradient<B> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<B> Default for Gradient<B> {
    fn default() -> Self {
        Self(Arc::default())
    }
}

impl<B> Gradient<B> {
    /// Takes the gradient that was added so far, if any.
    pub fn take(&self) -> Option<B> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Lets `write` add to the gradient, or to what `fresh` makes if there is none yet. It tells `write`
    /// whether the gradient is fresh.
    pub fn accumulate(&self, fresh: impl FnOnce() -> B, write: impl FnOnce(&mut B, bool)) {
        let mut slot = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let is_fresh = slot.is_none();
        write(slot.get_or_insert_with(fresh), is_fresh);
    }
}

/// The values of an activation. On a tape they are always f32; without one, layers that compute in
/// narrower formats leave them so.
#[derive(Debug)]
pub(super) enum Data {
    F32(Buffer),
    Narrow(Operand),
}

impl Data {
    /// Its extent.
    pub fn shape(&self) -> Shape {
        match self {
            Data::F32(buffer) => buffer.shape(),
            Data::Narrow(operand) => operand.shape(),
        }
    }

    /// The values, to read.
    ///
    /// # Panics
    /// If they are narrower; see [`Activation::into_f32`].
    pub fn view(&self) -> View<'_> {
        match self {
            Data::F32(buffer) => buffer.view(),
            Data::Narrow(_) => unreachable!("operations that read f32 ask for it"),
        }
    }
}

/// What an operation remembers of an activation: its values, and where its gradient goes.
#[derive(Clone, Debug)]
pub(super) struct Saved {
    pub data: Arc<Data>,
    /// `None` for network inputs and what untrained layers make of them, whose gradient is not needed.
    pub gradient: Option<Gradient<Buffer>>,
}

/// The output of a layer: shared values in the kernels' blocked layout and the tape that made them.
///
/// dfdx's tape orders the backward operations; the gradients of activations live beside the
/// activations, in the same blocked layout, and only those of parameters in dfdx's `Gradients`.
#[derive(Debug)]
pub struct Activation<T = NoneTape> {
    pub(super) saved: Saved,
    pub(super) tape: T,
}

impl<T: Tape<f32, Cpu>> Activation<T> {
    /// A network input from `(N, C, H, W)` values, with an empty tape. No gradient flows into it.
    ///
    /// # Panics
    /// If the length of `values` is not what `shape` demands.
    pub fn input(shape: Shape, values: &[f32]) -> Self {
        let mut data = Buffer::new(shape);
        to_blocked(values, 1, data.view_mut());
        Self::constant(Data::F32(data))
    }

    /// A network input at half resolution from `(N, C, H, W)` values: the four pixels of each quad
    /// become channels (space to depth). (N, C, H, W) -> (N, 4C, H/2, W/2)
    ///
    /// # Panics
    /// If rows or columns are odd, or the length of `values` is not what `shape` demands.
    pub fn input_halved(shape: Shape, values: &[f32]) -> Self {
        let mut data = Buffer::new(shape.quads());
        to_blocked(values, 2, data.view_mut());
        Self::constant(Data::F32(data))
    }

    /// Values with an empty tape, into which no gradient flows.
    pub(super) fn constant(data: Data) -> Self {
        Self { saved: Saved { data: Arc::new(data), gradient: None }, tape: T::default() }
    }

    /// A network input from a dfdx tensor, whose gradient is written to the tensor's.
    pub fn from_images(images: Images<T>) -> Self {
        let (images, mut tape) = images.split_tape();
        let &(n, c, h, w) = dfdx::shapes::HasShape::shape(&images);
        let shape = Shape::new(n, c, h, w);
        let mut data = Buffer::new(shape);
        to_blocked(&values_of(&images), 1, data.view_mut());
        let gradient = Gradient::<Buffer>::default();
        if T::OWNS_TAPE {
            let gradient = gradient.clone();
            tape.add_backward_op(move |gradients| {
                if let Some(g) = gradient.take() {
                    let mut values = vec![0.0; n * c * h * w];
                    from_blocked(g.view(), &mut values);
                    let into = gradients.get_or_alloc_mut(&images)?;
                    into.iter_mut().zip(&values).for_each(|(a, b)| *a += b);
                }
                Ok(())
            });
        }
        Self { saved: Saved { data: Arc::new(Data::F32(data)), gradient: Some(gradient) }, tape }
    }

    /// A second handle on the same activation, with an empty tape: the other branch of a skip.
    pub fn fork(&self) -> Self {
        Self { saved: self.saved.clone(), tape: T::default() }
    }

    /// Its extent.
    pub fn shape(&self) -> Shape {
        self.saved.data.shape()
    }

    /// The values as a dfdx tensor, (N, C, H, W), with the tape.
    pub fn into_images(self) -> Images<T> {
        let this = self.into_f32();
        let Shape { n, c, h, w, .. } = this.shape();
        let mut values = vec![0.0; n * c * h * w];
        from_blocked(this.saved.data.view(), &mut values);
        let images: Images = Cpu::default().tensor_from_vec(values, (n, c, h, w));
        let mut tape = this.tape;
        if T::OWNS_TAPE {
            let (of_tensor, saved) = (images.clone(), this.saved);
            tape.add_backward_op(move |gradients| {
                let values = std::mem::take(&mut **gradients.get_or_alloc_mut(&of_tensor)?);
                saved.accumulate(|gradient, fresh| {
                    if fresh {
                        to_blocked(&values, 1, gradient.view_mut());
                    } else {
                        let mut addend = Buffer::new(gradient.shape());
                        to_blocked(&values, 1, addend.view_mut());
                        crate::kernels::pool::add(gradient.view_mut(), addend.view());
                    }
                });
                Ok(())
            });
        }
        images.put_tape(tape)
    }

    /// The same values, in f32.
    pub(super) fn into_f32(self) -> Self {
        match &*self.saved.data {
            Data::F32(_) => self,
            Data::Narrow(operand) => {
                let mut buffer = Buffer::new(operand.shape());
                operand.widen(buffer.view_mut());
                Self { saved: Saved { data: Arc::new(Data::F32(buffer)), ..self.saved }, tape: self.tape }
            }
        }
    }

    /// The largest of the values, or 0.
    pub(super) fn peak(&self) -> f32 {
        let values = self.fork().into_f32();
        values.saved.data.view().data().iter().flat_map(|block| block.0).fold(0.0, f32::max)
    }

    /// Wraps the output of an operation. The operation `learns` if it has trained parameters, or reads
    /// something that has a gradient.
    pub(super) fn output(data: Data, tape: T, learns: bool) -> (Self, Saved) {
        let saved = Saved { data: Arc::new(data), gradient: learns.then(Gradient::default) };
        (Self { saved: saved.clone(), tape }, saved)
    }
}

impl Saved {
    /// Hands the gradient buffer to `write`, saying whether it is fresh (arbitrary interior) or holds
    /// a sum to add to. Does nothing for an input without gradient.
    pub fn accumulate(&self, write: impl FnOnce(&mut Buffer, bool)) {
        if let Some(gradient) = &self.gradient {
            gradient.accumulate(|| Buffer::new(self.data.shape()), write);
        }
    }

    /// Takes the gradient that has flowed in, if any.
    pub fn take_gradient(&self) -> Option<Buffer> {
        self.gradient.as_ref().and_then(Gradient::take)
    }
}
