//! Small sequences: a textured wall that moves by known vectors.

use std::path::Path;

use exr::prelude::*;

use super::files::{read_exr, values};

/// Columns and rows of a frame.
pub const SIZE: (usize, usize) = (48, 36);

/// How a frame is made.
#[derive(Clone, Copy)]
pub struct Shot {
    /// Pixels to the right that the wall moves by in a frame.
    pub speed: f32,
    /// Pixels downwards.
    pub fall: f32,
    /// By how many pixels more it moves in either direction from frame to frame.
    pub acceleration: f32,
    /// Whether the Vector pass is written.
    pub vectors: bool,
    /// What vectors are multiplied by.
    pub vector_scale: f32,
    /// Another number is another wall, in front of another camera.
    pub scene: u32,
    pub size: (usize, usize),
    /// Of the noise.
    pub seed: u32,
    /// Light from column `shadow + 3 * frame` on is a third.
    pub shadow: Option<f32>,
    /// By how much the light of frames of odd numbers is more, and that of the others less.
    pub flicker: f32,
    /// Whether bars of light, three columns wide and twelve apart, move by their width in each frame.
    pub bars: bool,
    /// The noise of a pixel: at most so much of its light, more or less.
    pub spread: f32,
    /// The light of a lamp that guides and vectors do not know, twelve columns further in each frame.
    pub lamp: f32,
}

/// One of which little is special.
pub const SHOT: Shot = Shot {
    speed: 2.0,
    fall: 0.0,
    acceleration: 0.0,
    vectors: true,
    vector_scale: 1.0,
    scene: 0,
    size: SIZE,
    seed: 1,
    shadow: None,
    flicker: 0.0,
    bars: false,
    spread: 0.8,
    lamp: 0.0,
};

/// A number from 0 to 1 that depends on all of `parts`.
pub fn random(parts: [u32; 3]) -> f32 {
    let mix = |hash: u32, part: u32| {
        (hash ^ part).wrapping_mul(0x85eb_ca6b).rotate_left(13).wrapping_mul(0xc2b2_ae35)
    };
    let hash = parts.into_iter().fold(0x9e37_79b9, mix);
    ((hash ^ (hash >> 15)) >> 8) as f32 / (1 << 24) as f32
}

impl Shot {
    /// How far to the right, and how far down, the wall is in a frame.
    fn place(&self, frame: i64) -> (f32, f32) {
        let frame = frame as f32;
        let further = self.acceleration * frame * (frame + 1.0) / 2.0;
        (self.speed * frame + further, self.fall * frame + further)
    }

    /// Colour of the wall at a pixel of a frame.
    pub fn albedo(&self, c: usize, (x, y): (f32, f32), frame: i64) -> f32 {
        let place = self.place(frame);
        let (x, y) = (x - place.0, y - place.1);
        let phase = c as f32 + 2.0 * self.scene as f32;
        // Systems differ in the last bit of a sine, which f32 does not hold.
        let (wide, high) = (f64::from(0.25 * x + phase), f64::from(0.3 * y + 1.7 * self.scene as f32));
        (0.5 + 0.3 * wide.sin() * high.cos()) as f32
    }

    pub fn light(&self, x: f32, frame: i64) -> f32 {
        let light = match self.shadow {
            Some(edge) if x > edge + 3.0 * frame as f32 => 0.3,
            _ if self.bars && (x as i64 - 3 * frame).rem_euclid(12) < 3 => 3.0,
            _ => 0.9,
        };
        light * if frame % 2 == 0 { 1.0 - self.flicker } else { 1.0 + self.flicker }
    }

    /// Whether a pixel of a frame shows the lamp.
    pub fn is_lamp(&self, i: usize, frame: i64) -> bool {
        let (x, y) = (i % self.size.0, i / self.size.0);
        let first = 12 * frame as usize;
        self.lamp > 0.0 && (first..first + 6).contains(&x) && (12..18).contains(&y)
    }

    /// Combined without noise.
    pub fn truth(&self, c: usize, i: usize, frame: i64) -> f32 {
        if self.is_lamp(i, frame) {
            return self.lamp;
        }
        let place = ((i % self.size.0) as f32, (i / self.size.0) as f32);
        self.light(place.0, frame) * self.albedo(c, place, frame)
    }

    pub fn noise(&self, i: usize, frame: i64) -> f32 {
        1.0 + self.spread * (2.0 * random([self.seed, frame as u32, i as u32]) - 1.0)
    }

    /// The channels of a view layer, or of one stereo view of it.
    pub fn channels(&self, layer: &str, view: &str, frame: i64) -> Vec<AnyChannel<FlatSamples>> {
        let pixels = self.size.0 * self.size.1;
        let mut list = Vec::new();
        let mut add = |pass: &str, component: &str, value: &dyn Fn(usize) -> f32| {
            let samples = FlatSamples::F32((0..pixels).map(value).collect());
            list.push(AnyChannel::new(format!("{layer}.{pass}.{view}{component}").as_str(), samples));
        };
        for (c, name) in ["R", "G", "B"].into_iter().enumerate() {
            add("Combined", name, &|i| self.truth(c, i, frame) * self.noise(i, frame));
            add("Denoising Albedo", name, &|i| {
                self.albedo(c, ((i % self.size.0) as f32, (i / self.size.0) as f32), frame)
            });
        }
        for (name, value) in [("X", 0.0), ("Y", 0.6 * self.scene as f32), ("Z", 1.0)] {
            add("Denoising Normal", name, &|_| value);
        }
        add("Denoising Depth", "Z", &|_| 5.0 + 3.0 * self.scene as f32);
        if self.vectors {
            // To the right and upwards: from the frame before, backwards; to the frame after, backwards.
            let [before, here, after] = [-1, 0, 1].map(|by| self.place(frame + by));
            let (x, y) = (before.0 - here.0, here.1 - before.1);
            let (z, w) = (here.0 - after.0, after.1 - here.1);
            for (name, value) in [("X", x), ("Y", y), ("Z", z), ("W", w)] {
                add("Vector", name, &|_| value * self.vector_scale);
            }
        }
        list
    }

    pub fn write(&self, path: &Path, frame: i64) {
        write_channels(path, self.size, self.channels("ViewLayer", "", frame), &[]);
    }

    /// The mean squared error of a result away from the borders, where neighbours show as much as the frame.
    pub fn error(&self, result: &Path, layer: &str, frame: i64) -> f32 {
        let image = read_exr(result);
        let (w, h) = self.size;
        let (mut sum, mut count) = (0.0, 0.0);
        for (c, name) in ["R", "G", "B"].into_iter().enumerate() {
            let got = values(&image, &format!("{layer}.{name}"));
            for i in (0..w * h).filter(|i| (8..w - 8).contains(&(i % w)) && (6..h - 6).contains(&(i / w))) {
                sum += (got[i] - self.truth(c, i, frame)).powi(2);
                count += 1.0;
            }
        }
        sum / count
    }
}

/// Writes channels as a file of one part, which has these stereo views.
pub fn write_channels(path: &Path, size: (usize, usize), list: Vec<AnyChannel<FlatSamples>>, views: &[&str]) {
    let mut attributes = LayerAttributes::default();
    if !views.is_empty() {
        attributes.multi_view_names = Some(views.iter().map(|view| Text::from(*view)).collect());
    }
    let channels = AnyChannels::sort(list.into_iter().collect());
    let layer = Layer::new(size, attributes, Encoding::SMALL_LOSSLESS, channels);
    Image::from_layer(layer).write().to_file(path).unwrap();
}
